"""Cyclic garbage of episodes on two controllers: objects and memory that stay, and the time of the collections.

python benchmarks/garbage.py [--episodes 1000] [--cycles 100] [--json FILE]

Each episode leaves cycles, as exceptions with tracebacks are, that live when the next one begins. Two ways to prepare
an episode are compared: `GarbageCollector`, and a freeze of all objects each time. A full collection of the whole
program, with PyTorch and Stable-Baselines3 loaded, is timed as well.
"""

import argparse
import gc
import json
import os
import statistics
import time
from pathlib import Path

import gymnasium  # noqa: F401
import stable_baselines3  # noqa: F401  # a large program

import dual_ur10  # noqa: F401
from dual_ur10.sim2real.processes.garbage import GarbageCollector


class Cycle:
    """Object in a cycle."""

    def __init__(self):
        self.itself, self.data = self, [0] * 20


def rss_mib() -> float:
    """Return the resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def measure(prepare, episodes: int, cycles: int) -> dict:
    """Return growth over some episodes after the first, and times of `prepare`."""
    prepare()
    frozen, rss, times_ms = gc.get_freeze_count(), rss_mib(), []
    for _ in range(episodes):
        left = [Cycle() for _ in range(cycles)]
        begin = time.perf_counter()
        prepare()
        times_ms.append(1e3 * (time.perf_counter() - begin))
    del left
    return {
        "frozen": gc.get_freeze_count() - frozen,
        "rss_mib": round(rss_mib() - rss, 1),
        "median_ms": round(statistics.median(times_ms), 3),
        "largest_ms": round(max(times_ms), 3),
    }


def main() -> None:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--cycles", type=int, default=100)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    whole_ms = []
    for _ in range(20):
        begin = time.perf_counter()
        gc.collect()
        whole_ms.append(1e3 * (time.perf_counter() - begin))
    collector = GarbageCollector()
    found = {"collector": measure(collector.prepare_episode, arguments.episodes, arguments.cycles)}
    collector.release()
    found["freeze"] = measure(gc.freeze, arguments.episodes, arguments.cycles)
    found["whole"] = {"median_ms": round(statistics.median(whole_ms), 1), "largest_ms": round(max(whole_ms), 1)}
    print(json.dumps(found, indent=2))
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
