"""Memory, counters and clocks of a virtual cell over hours of virtual time.

    python benchmarks/endurance.py [--hours 24] [--seed 0] [--json FILE]

SineTracking with its scripted policy and a record, episode after episode. About every minute a fault stops both arms,
or an action is late; the fault is cleared, the environment made again, and it goes on. Every ten virtual minutes a line
reports resident memory, live objects, open files and connections. At the end: growth since the first hour, targets
that were sent and did not arrive, and the largest deviation of the clock estimates.
"""

import argparse
import gc
import json
import os
import pathlib
import shutil
import tempfile
import time

import gymnasium as gym
import numpy as np
import psutil

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.errors import CellFaulted, DualUR10Error
from dual_ur10.policies import load
from dual_ur10.testing import VirtualCell
from ur_core.kinematics.ur10 import ARMS

ENV_ID = "DualUR10/SineTracking-v0"
REPORT_S = 600.0
FAULT_S = 60.0
WARM_S = 3600.0


class Endurance:
    """Episodes on one virtual cell, with faults.

    Args:
        seed: Seed of episodes and faults.
        folder: Folder of the records; each is removed once it was closed.
    """

    def __init__(self, seed: int, folder: pathlib.Path) -> None:
        self.random = np.random.default_rng(seed)
        self.folder = folder
        self.cell = VirtualCell(task=ENV_ID, seed=seed)
        self.policy = load("scripted", ENV_ID)
        self.process = psutil.Process()
        self.counts = dict.fromkeys(("episodes", "steps", "faults", "late_actions", "targets", "lost_targets"), 0)
        self.rows: list[dict[str, float]] = []
        self.begin_s = self.cell.now_s
        self.fault_s = FAULT_S
        self.env = self.make()

    @property
    def passed_s(self) -> float:
        """Virtual time so far, s."""
        return self.cell.now_s - self.begin_s

    def make(self) -> gym.Env:
        """Make an environment."""
        self.received = [self.cell.ask("received", arm=arm, since=1 << 40)["motion"] for arm in ARMS]
        return gym.make(ENV_ID, cell=self.cell, record=str(self.folder), disable_env_checker=True)

    def close(self) -> None:
        """Close the environment, and compare what was sent with what arrived."""
        core = self.env.unwrapped.core
        sent = [memory.sent_count for memory in core.cell.runner.arms]
        self.counts["late_actions"] += core.late_actions
        faulted = bool(self.cell.fault)
        self.env.close()
        for arm, name in enumerate(ARMS):
            arrived = self.cell.ask("received", arm=name, since=1 << 40)["motion"] - self.received[arm]
            self.counts["targets"] += arrived
            if not faulted:  # the stop ramp, which `sent` does not have yet, comes after
                self.counts["lost_targets"] += max(0, sent[arm] - arrived)
        shutil.rmtree(self.folder)
        self.folder.mkdir()

    def episode(self) -> None:
        """Run an episode, with a fault or a late action if one is due."""
        consent = {"options": {"move_to_start": True}}
        observation, _ = self.env.reset(seed=int(self.random.integers(1 << 31)), **consent)
        self.policy.reset()
        ended = False
        while not ended:
            if self.passed_s > self.fault_s:
                self.fault_s = self.passed_s + FAULT_S * self.random.uniform(0.5, 1.5)
                self.inject()
            observation, _, terminated, truncated, _ = self.env.step(self.policy(observation))
            self.counts["steps"] += 1
            ended = terminated or truncated
        self.counts["episodes"] += 1

    def inject(self) -> None:
        """Inject a random fault."""
        arm = ARMS[self.random.integers(2)]
        kind = self.random.integers(5)
        if kind == 0:
            self.cell.clock.sleep(0.3)  # a late action
        elif kind == 1:
            self.cell.ask("stop", arm=arm, mode=3)
        elif kind == 2:
            self.cell.ask("press", arm=arm, button="stop")
        elif kind == 3:
            self.cell.stall(arm, 0.3)
        else:
            self.cell.ask("drop", arm=arm, port="rtde", reset=True)

    def recover(self) -> None:
        """Clear the fault, as a person does, and make the environment again."""
        self.counts["faults"] += 1
        self.close()
        self.cell.clock.sleep(6.0)
        for arm in ARMS:
            if self.cell.ask("state", arm=arm, names=["safety_mode"])["safety_mode"] == 3:
                self.cell.ask("press", arm=arm, button="unlock_protective_stop")
                self.cell.wait_until(arm, "safety_mode", 1)
            self.cell.wait_until(arm, "runtime_state", 1)
        self.cell.clear()
        self.env = self.make()

    def report(self) -> None:
        """Report memory and time."""
        gc.collect()
        world = self.cell._world
        row = {
            "virtual_h": round(self.passed_s / 3600.0, 3),
            "rss_mib": round(self.process.memory_info().rss / 2**20, 2),
            "objects": len(gc.get_objects()),
            "frozen": gc.get_freeze_count(),
            "files": self.process.num_fds(),
            "connections": len(world.scheduler.files),
            "processes": len(world.processes),
            "processor_s": round(time.process_time(), 1),
            **self.counts,
        }
        self.rows.append(row)
        print(json.dumps(row), flush=True)

    def run(self, seconds: float) -> None:
        """Run for a virtual time."""
        due_s = 0.0
        while self.passed_s < seconds:
            if self.passed_s >= due_s:
                due_s += REPORT_S
                self.report()
            try:
                self.episode()
            except CellFaulted:
                self.recover()
            except DualUR10Error as error:
                raise SystemExit(f"after {self.passed_s:.0f} s: {error}") from error
        self.report()
        self.close()
        self.cell.close()


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=pathlib.Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        endurance = Endurance(options.seed, pathlib.Path(folder))
        endurance.run(3600.0 * options.hours)
    warm = [row for row in endurance.rows if 3600.0 * row["virtual_h"] >= min(WARM_S, 3600.0 * options.hours / 4)]
    found = {
        "virtual_h": warm[-1]["virtual_h"],
        "growth_of_memory": warm[-1]["rss_mib"] / warm[0]["rss_mib"] - 1.0,
        "growth_of_objects": warm[-1]["objects"] / warm[0]["objects"] - 1.0,
        "rows": endurance.rows,
        "load": os.getloadavg()[0],
    }
    print(json.dumps({name: value for name, value in found.items() if name != "rows"}, indent=2))
    if options.json:
        options.json.write_text(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
