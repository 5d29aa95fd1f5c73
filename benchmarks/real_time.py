"""Episodes without a late action on an emulated cell in real time, and the processor time of each process.

    python benchmarks/real_time.py [--family e-series] [--tasks SineTracking,Handover] [--episodes 10] [--json FILE]

Scripted episodes at the default latency, as `python -m dual_ur10 rollout` runs them: emulated controllers, program,
processes of both arms, supervisor and recorder on this machine. An episode passes that succeeds without a late action.
Shares of the processor are means over all episodes without a stop, with their ways to the start; 1.0 is one core.
Latenesses are those of the emulated control periods in the last 20 s (e-Series) or 80 s (CB3) of each episode, the
worst of all episodes. Run it on a quiet machine, whose load is printed too.
"""

import argparse
import contextlib
import json
import os
import pathlib
import sys
import tempfile
import time
from collections import Counter

import gymnasium as gym
import psutil

from dual_ur10.emulated.emulated_cell import EmulatedCell
from dual_ur10.errors import DualUR10Error
from dual_ur10.policies import load, rollout
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.runtime.latch import Latch
from ur_core.kinematics.ur10 import ARMS, TICK_S


def processor_s(cell):
    """Return the processor time of each process so far, by name."""
    this, found = psutil.Process(), Counter()
    for each in (this, *this.children()):
        with contextlib.suppress(psutil.NoSuchProcess):
            name = {this.pid: "program", cell.process.pid: "emulator"}.get(each.pid) or each.cmdline()[-1]
            found[name] += sum(each.cpu_times()[:2])
    return found


def measure(task, family, episodes):
    """Run the episodes of a task, and return their figures. A stop of both arms fails an episode."""
    env_id, env, used, wall_s = f"DualUR10/{task}-v0", None, Counter(), 0.0
    found, stops, infos = [], [], []
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        path = pathlib.Path(folder) / "cell.toml"
        cell = stack.enter_context(EmulatedCell(task=task, cell=str(path), family=family))
        for seed in range(episodes):
            if env is None:
                for arm in ARMS:
                    cell.wait_until(arm, "robot_mode", 7)
                    cell.wait_until(arm, "runtime_state", 1)
                env = stack.enter_context(
                    contextlib.closing(gym.make(env_id, cell=str(path), disable_env_checker=True))
                )
            policy, success, stop = load("scripted", env_id, cell=str(path)), False, ""
            late, before, begin = env.unwrapped.core.late_actions, processor_s(cell), time.monotonic()
            try:
                success = bool(rollout(env, policy, seed=seed).success)
            except DualUR10Error as error:
                stop = str(error)
            if not stop:  # it has ended processes
                after = processor_s(cell)
                wall_s += time.monotonic() - begin
                used.update({name: after[name] - before[name] for name in before})
            found.append((success, env.unwrapped.core.late_actions - late))
            infos.append(cell.ask("info"))
            if stop:
                stops.append(stop)
                env.close()
                env = None
                Latch(load_cell_file(path)).clear()
            print(f"{task}, seed {seed}: success {success}, late actions {found[-1][1]}", file=sys.stderr)
    share = {name: seconds / wall_s for name, seconds in sorted(used.items())}
    return {
        "passed": sum(success and not late for success, late in found),
        "succeeded": sum(success for success, _ in found),
        "episodes": episodes,
        "late_actions": [late for _, late in found],
        "stops": stops,
        "processor": share,
        "processor_all": sum(share.values()),
        "lateness_p99_ms": 1e3 * max(each["lateness_p99_s"] for each in infos),
        "lateness_max_ms": 1e3 * max(each["lateness_max_s"] for each in infos),
        "lost_s": infos[-1]["lost_s"],
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--family", choices=tuple(TICK_S), default="e-series", help="of both controllers")
    parser.add_argument("--tasks", default="SineTracking,Handover")
    parser.add_argument("--episodes", type=int, default=10, help="of each task")
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()
    figures = {"family": args.family}
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_STATE_HOME"] = folder
        for task in args.tasks.split(","):
            load_before = os.getloadavg()[0]
            found = measure(task, args.family, args.episodes)
            figures[task] = {**found, "load": load_before, "load_after": os.getloadavg()[0]}
            if args.json:  # after every task: a later one may find the machine too busy
                args.json.parent.mkdir(parents=True, exist_ok=True)
                args.json.write_text(json.dumps(figures, indent=1))
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
