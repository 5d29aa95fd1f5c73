"""Deliberate breaks of the motion path, each of which the fault simulator must find.

`python -m tests.virtual.mutants` applies each of them to a copy of the package and runs seeds of the fault simulator there:
the first 500 with a fault of the kinds that concern the break. For a break that only rare schedules show, it runs the named
test of that fault instead. The working tree is not changed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

_ROOT = Path(__file__).parents[2]
_MOST_SEEDS = 500
_LIMIT_S = 3600


class PatchError(Exception):
    """The text of a patch is not in its file exactly once."""


@dataclass(frozen=True)
class Mutant:
    """Deliberate break.

    Attributes:
        name: What is broken.
        path: File in the package.
        old: Text, once in that file.
        new: Its replacement.
        kinds: Kinds of faults whose seeds are run; empty: all.
        phase: Phase of those faults; "": any.
        test: Named test to run instead of seeds; "": none.
    """

    name: str
    path: str
    old: str
    new: str
    kinds: tuple[str, ...] = ()
    phase: str = "motion"
    test: str = ""

    def patched(self, root: Path) -> str:
        """Return the text of the broken file.

        Raises:
            PatchError: The text to replace is not there exactly once.
        """
        text = (root / self.path).read_text()
        if text.count(self.old) != 1:
            raise PatchError(
                f"{self.name}: {self.old!r} is {text.count(self.old)} times in {self.path}: adapt the patch"
            )
        return text.replace(self.old, self.new)


_SENDER = "dual_ur10/sim2real/runtime/arm_sender.py"
_SUPERVISOR = "dual_ur10/sim2real/runtime/supervisor.py"
_MONITOR = "dual_ur10/sim2real/runtime/safety_monitor.py"
_ENFORCER = "dual_ur10/sim2real/runtime/stop_enforcer.py"
_LATCH = "dual_ur10/sim2real/runtime/latch.py"
_RUNNER = "dual_ur10/sim2real/runtime/runner.py"
_SCALING = "dual_ur10/sim2real/control/time_scaling.py"
_GATE = "packages/ur-core/ur_core/kernel/gate.hpp"
_CORE = "dual_ur10/envs/core/core.py"
_STOPS = ("safety", "press")

MUTANTS = (
    Mutant("sender ignores the other processes", _SENDER, "            self._check_others(now)\n", "", _STOPS),
    Mutant("sender sends late targets in a burst", _SENDER, "            if passed > 0:\n", "            if passed > 1000:\n", ("stall",)),
    Mutant("sender is ahead of time", _SENDER, "period + ahead + drift(", "period + 8 + ahead + drift("),
    Mutant("sender sends old targets", _SENDER, "target = self.memory.target(index)\n            self._send", "target = self.memory.target(index - 3)\n            self._send"),
    Mutant("stop leaves the path", _SENDER, "on_path = on_path and advance > 0.0", "on_path = False", ("policy",)),
    Mutant("stop without a ramp", _SENDER, "        while not ramp.at_rest:\n", "        while False:\n", ("policy", "death")),
    Mutant("program is not ended", _SENDER, "            self.control.stopScript()\n", "", ("slider", "second")),
    Mutant("watchdog is not fed before the start", _SENDER, "        self._kicked_s = now\n            if not self.control.kickWatchdog():", "        self._kicked_s = now\n            if False:", (), ""),
    Mutant("a stale supervisor is accepted", _SENDER, "now - self.cell.supervisor_beat_s > STALE_S", "False", ("stall", "death")),
    Mutant("watchdog of 1 Hz", "dual_ur10/sim2real/runtime/arm_process.py", "control.setWatchdog(WATCHDOG_HZ)", "control.setWatchdog(1.0)"),
    Mutant("ramp is too slow", _SENDER, "STOP_RAD_S2: Final = 4.0", "STOP_RAD_S2: Final = 0.1", ("policy", "death")),
    Mutant("ramp is too hard", _SENDER, "STOP_RAD_S3: Final = 200.0", "STOP_RAD_S3: Final = 2e5; STOP_RAD_S2 = 60.0", ("policy", "death")),
    Mutant("brake after the targets is missing", _RUNNER, "brake = past[-1] + self._brake @ (past - past[-1])", "brake = past[-1] + 0 * self._brake @ (past - past[-1])"),
    Mutant("targets pass the gate and change", _RUNNER, "whole = np.concatenate([targets_rad,", "whole = np.concatenate([targets_rad + 1e-7,"),
    Mutant("gate forgets what it released", _GATE, "        copy(past, window + e.ticks * JOINTS, HISTORY * JOINTS);\n", "        (void)past;\n"),
    Mutant("late targets are written", _RUNNER, "        if first < self.next:\n", "        if False:\n", ("policy",)),
    Mutant("both arms get the targets of one", _RUNNER, "memory.put(first, targets_rad[:, arm])", "memory.put(first, targets_rad[:, 0])", ("slider",)),
    Mutant("program is not told of a stop", _RUNNER, "        if self._fault:\n            raise CellFaulted(", "        if False:\n            raise CellFaulted(", _STOPS),
    Mutant("nothing is latched", _LATCH, "        for path in self._paths:\n            with contextlib", "        for path in ():\n            with contextlib", _STOPS),
    Mutant("a latched stop does not prevent a start", _LATCH, "        if fault is not None:\n", "        if False:\n", _STOPS),
    Mutant("two programs get the arms", _LATCH, "            self._take(file)\n", "            pass\n", ("second",)),
    Mutant("supervisor ignores the policy's silence", _MONITOR, "POLICY_S: Final = 0.5", "POLICY_S: Final = 50.0", ("policy",)),
    Mutant("a refused action does not stop the arms", _CORE, '            cell.stop(f"the policy\'s action was refused: {error}")\n', "", ("policy",)),
    Mutant("a paused program may continue", _ENFORCER, "                if not ended[arm]:\n                    self._request_stop(arm)", "                if not ended[arm]:\n                    pass", test="test_ends.py::test_33_the_dashboard_ends_a_program_paused_by_a_stop"),
    Mutant("loss of the backup stop is ignored", _ENFORCER, "            link.check()\n", "", ("drop",)),
    Mutant("speed sliders are ignored", _SUPERVISOR, "allowed = scaling_from_slider(self._monitor.slowest) * self._file.speed_factor", "allowed = self._file.speed_factor", ("slider",)),
    Mutant("arms slow down at once", _SCALING, "SLOWING_PER_S: Final = 4.0", "SLOWING_PER_S: Final = 400.0", ("slider",)),
    Mutant("time scaling runs away", _SCALING, "return self.index + self.rate * passed\n        sign", "return self.index + 1.2 * self.rate * passed\n        sign"),
    Mutant("interpolation between targets is wrong", _SCALING, "(stop - before) / 2, (after - start) / 2", "(stop - before), (after - start)"),
    Mutant("a silent controller is not noticed", "packages/ur-core/ur_core/links/rtde_link.py", "        return now_s - self._stream.alive_s\n", "        return 0.0\n", test="test_network.py::test_20_a_controller_that_falls_silent_stops_both"),
)  # fmt: skip
"""Breaks of sender, ramp, gate (in the compiled kernel), program, latch, supervisor, time scaling and links."""


def copy(root: Path, target: Path) -> None:
    """Copy the packages and their tests."""
    ignored = shutil.ignore_patterns("__pycache__")
    for name in ("dual_ur10", "packages", "tests"):
        shutil.copytree(root / name, target / name, ignore=ignored)
    shutil.copy(root / "pyproject.toml", target)


def apply(mutant: Mutant, target: Path) -> None:
    """Break the copy in `target`, and compile its kernel again if that is what is broken."""
    (target / mutant.path).write_text(mutant.patched(_ROOT))
    if mutant.path.endswith(".hpp"):
        subprocess.run([sys.executable, "packages/ur-core/hatch_build.py"], cwd=target, check=True)


def seeds_for(mutant: Mutant) -> list[int]:
    """Return the seeds to run, quick cells first."""
    from tests.virtual.schedule import draw

    found = []
    for seed in range(30_000):
        schedule = draw(seed)
        concerned = [
            each
            for each in schedule.faults
            if (not mutant.kinds or each.kind in mutant.kinds) and mutant.phase in ("", each.when)
        ]
        cell = schedule.cell
        if concerned and cell.task == "SineTracking" and cell.family == "cb3" and not cell.far and not cell.again:
            found.append(seed)
        if len(found) == _MOST_SEEDS:
            break
    return found


def hunt(number: int, most: int) -> tuple[int, str]:
    """Run seeds in this process, whose package is broken; return their number and the first violation."""
    from tests.virtual.simulate import trial

    seeds = seeds_for(MUTANTS[number])[:most]
    for count, seed in enumerate(seeds, 1):
        _, outcome = trial(seed)
        if outcome.violations:
            return count, f"seed {seed}: {outcome.violations[0]}"
    return len(seeds), ""


def check(number: int, most: int) -> tuple[int, str]:
    """Break a copy of the package and run seeds or a named test on it in a process of its own."""
    mutant = MUTANTS[number]
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder)
        copy(_ROOT, target)
        apply(mutant, target)
        command = [sys.executable, "-m", "tests.virtual.mutants", "--hunt", str(number), "--seeds", str(most)]
        if mutant.test:
            command = [sys.executable, "-m", "pytest", "-x", f"tests/virtual/faults/{mutant.test}"]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(map(str, (target, *(target / "packages").iterdir()))),
        }
        found = subprocess.run(
            command, cwd=target, env=environment, capture_output=True, text=True, timeout=_LIMIT_S, check=False
        )
    if mutant.test:
        return 0, f"{mutant.test} fails" if found.returncode == pytest.ExitCode.TESTS_FAILED else ""
    lines = [each for each in found.stdout.splitlines() if each.startswith("hunted\t")]
    if not lines:
        return 0, f"the simulator failed: {found.stderr.strip().splitlines()[-1:]}"
    _, count, text = lines[-1].split("\t", 2)
    return int(count), text


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table of all mutants; return 1 if one was not found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=_MOST_SEEDS, help="largest number of seeds for each")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of mutants")
    parser.add_argument("--hunt", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.hunt is not None:
        import dual_ur10

        if Path(dual_ur10.__file__).parents[1] != Path.cwd():
            raise PatchError(f"{dual_ur10.__file__} is not the broken copy in {Path.cwd()}")
        count, text = hunt(given.hunt, given.seeds)
        print("hunted", count, " ".join(text.split()), sep="\t")
        return 0
    missed = 0
    for number in given.only or range(len(MUTANTS)):
        begin = time.monotonic()
        count, text = check(number, given.seeds)
        missed += not text
        mutant = MUTANTS[number]
        print(
            f"| {number + 1} | {mutant.name} | {count} | {text or 'NOT FOUND'} | {time.monotonic() - begin:.0f} s |",
            flush=True,
        )
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
