"""Comparisons in one run: another checkout of this project, or another simulator, block by block in turn with this one.

Each side is a process of its own, which waits while another one has its block. So other work of the machine affects all
alike, and the median of the ratios of a round depends little on it. throughput.py prints the results.
"""

from __future__ import annotations

import contextlib
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
WORKERS = Path(__file__).resolve().parent / "workers"
BLOCK_S = 1.0
PEERS = {"SyncCarry": "TwoArmLift", "Handover": "TwoArmHandover"}
"""Task of robosuite for each of ours."""

Block = dict[str, float]
"""Figures of a block: environment steps, simulated, elapsed and processor seconds, by the names that workers use."""


class Worker:
    """Process that runs blocks of one case.

    Args:
        python: Interpreter.
        script: Script in the folder `workers`.
        case: Case, as the script reads it.
        path: Checkout on its import path; None: none.

    Attributes:
        about: Versions, and where the package lies.
        steps: Steps of a block, which takes about a second.

    Raises:
        SystemExit: The process ended, or has imported another checkout.
    """

    def __init__(self, python: Path, script: str, case: dict[str, Any], path: Path | None = None) -> None:
        self._command = [str(python), str(WORKERS / script)]
        others = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        environment = others if path is None else {**others, "PYTHONPATH": str(path)}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        self._process: Any = subprocess.Popen(self._command, env=environment, text=True, **pipes)
        self.about = self._ask(case)
        if path is not None and not Path(self.about["file"]).is_relative_to(path):
            self.close()
            sys.exit(
                f"{python} imports dual_ur10 from {self.about['file']}, expected {path}: an installed version comes "
                "first. Make a virtual environment for that checkout, and name its interpreter with --against-python"
            )
        self.steps = 20
        self.block()
        self.steps = max(1, round(self.steps * BLOCK_S / self.block()["wall_s"]))

    def _ask(self, question: object) -> dict[str, Any]:
        with contextlib.suppress(BrokenPipeError):  # it has ended, and answers nothing
            self._process.stdin.write(json.dumps(question) + "\n")
            self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            self.close()
            sys.exit(f"{' '.join(self._command)} ended with code {self._process.returncode}: run it by hand")
        return json.loads(answer)

    def block(self) -> Block:
        """Run a block."""
        return self._ask(self.steps)

    def close(self) -> None:
        """End the process."""
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


def rounds_of(workers: Sequence[Worker], rounds: int) -> list[list[Block]]:
    """Return the blocks of each worker, which take turns in an order that changes."""
    found: list[list[Block]] = [[] for _ in workers]
    for k in range(rounds):
        for turn in range(len(workers)):
            each = (turn + k) % len(workers)
            found[each].append(workers[each].block())
    return found


def rate(blocks: list[Block], amount: str, per: str) -> float:
    """Return the median over the blocks of one figure by another."""
    return statistics.median(block[amount] / block[per] for block in blocks)


def ratio(ours: list[Block], theirs: list[Block], amount: str, per: str) -> float:
    """Return the median over the rounds of our rate by theirs."""
    pairs = zip(ours, theirs, strict=True)
    return statistics.median(a[amount] / a[per] / (b[amount] / b[per]) for a, b in pairs)


def against(path: Path, python: Path, tasks: Sequence[str], envs: int, threads: int, rounds: int) -> dict[str, Any]:
    """Compare environment steps per second, random actions, with those of another checkout; print each row.

    Args:
        path: The other checkout.
        python: Its interpreter.
        tasks: Names of the tasks.
        envs: Cells in a batch; one environment is measured, too.
        threads: Threads of the batch.
        rounds: Blocks of each side.
    """
    path = path.resolve()
    figures: dict[str, Any] = {}
    print(f"random actions against {path}, {rounds} blocks of each in turn")
    print(f"{'case':34}{'ratio':>8}{'env-steps/s':>14}{'there':>12}")
    for task in tasks:
        for key, n in (("single_random", 1), (f"vector{envs}_random", envs)):
            case = {"task": task, "envs": n, "threads": threads}
            sides = [
                Worker(Path(sys.executable), "dual_ur10_worker.py", case, ROOT),
                Worker(python, "dual_ur10_worker.py", case, path),
            ]
            ours, theirs = rounds_of(sides, rounds)
            for side in sides:
                side.close()
            found = {
                "ratio": round(ratio(ours, theirs, "env_steps", "wall_s"), 3),
                "env_steps_per_s": round(rate(ours, "env_steps", "wall_s"), 1),
                "env_steps_per_s_there": round(rate(theirs, "env_steps", "wall_s"), 1),
            }
            figures.setdefault(task, {})[key] = found
            row = "".join(f"{value:{width}}" for value, width in zip(found.values(), (8, 14, 12), strict=True))
            print(f"{task + ', ' + key:34}{row}", flush=True)
    return figures


def robosuite(python: Path, envs: int, threads: int, rounds: int) -> dict[str, Any]:
    """Compare simulated seconds per processor second, random actions, with robosuite's two-arm tasks; print each row.

    Args:
        python: Interpreter of a virtual environment with robosuite.
        envs: Cells in a batch; one environment is measured, too.
        threads: Threads of the batch.
        rounds: Blocks of each side.
    """
    figures: dict[str, Any] = {}
    for task, peer in PEERS.items():
        sides = [Worker(python, "robosuite_worker.py", {"task": peer})]
        for n in (1, envs):
            case = {"task": task, "envs": n, "threads": threads}
            sides.append(Worker(Path(sys.executable), "dual_ur10_worker.py", case, ROOT))
        blocks = rounds_of(sides, rounds)
        versions = {"there": sides[0].about, "here": {name: sides[1].about[name] for name in ("mujoco", "numpy")}}
        for side in sides:
            side.close()
        amount = "simulated_s", "cpu_s"
        theirs = rate(blocks[0], *amount)
        print(f"{task} and robosuite's {peer}, {rounds} blocks of each in turn, random actions; {versions}")
        print(f"{peer}: {theirs:.2f} simulated s per CPU s")
        found: dict[str, Any] = {"versions": versions, peer: round(theirs, 3)}
        for key, ours in zip(("single_random", f"vector{envs}_random"), blocks[1:], strict=True):
            own, times = rate(ours, *amount), ratio(ours, blocks[0], *amount)
            found[key] = {"sim_s_per_cpu_s": round(own, 2), "ratio": round(times, 2)}
            print(f"{task}, {key}: {own:.1f} simulated s per CPU s, {times:.1f} times as many", flush=True)
        figures[task] = found
    return figures
