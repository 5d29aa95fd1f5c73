"""Fault simulator: random schedules of faults on virtual cells, checked by invariants.

`python -m tests.virtual.simulate --seeds 0:1000` runs seeds, `--seed 123` one of them, `--schedule file.toml` a file.
A seed that breaks an invariant is printed with the line that replays it, and shrunk to the fewest faults.
"""

from __future__ import annotations

import argparse
import collections
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from dual_ur10.errors import DualUR10Error
from tests.virtual.schedule import Cell, Schedule, draw, load, text
from tests.virtual.simulation import Outcome, run

_PER_PROCESS = 100  # seeds, after which memory is released with the process


def trial(seed: int) -> tuple[int, Outcome]:
    """Run one seed; an error of the simulator itself is a violation, too."""
    try:
        return seed, run(draw(seed))
    except Exception as error:
        return seed, Outcome([f"{type(error).__name__}: {error}"])


def simpler(schedule: Schedule) -> Iterator[Schedule]:
    """Yield schedules that are simpler by one step."""
    for number in range(len(schedule.faults)):
        faults = schedule.faults[:number] + schedule.faults[number + 1 :]
        yield schedule.model_copy(update={"faults": faults})
    plain = Cell()
    for name in Cell.model_fields:
        if getattr(schedule.cell, name) != getattr(plain, name):
            cell = schedule.cell.model_copy(update={name: getattr(plain, name)})
            yield schedule.model_copy(update={"cell": cell})
    for number, fault in enumerate(schedule.faults):
        for name in ("at_s", "duration_s", "amount"):
            value = getattr(fault, name, 0.0)
            for digits in (1, 2):
                rounded = round(value, digits)
                if rounded != value:
                    changed = fault.model_copy(update={name: rounded})
                    faults = (*schedule.faults[:number], changed, *schedule.faults[number + 1 :])
                    yield schedule.model_copy(update={"faults": faults})


def shrink(schedule: Schedule, most: int = 60) -> Schedule:
    """Return the simplest schedule that still breaks an invariant, after at most so many trials."""
    trials = 0
    while True:
        for candidate in simpler(schedule):
            trials += 1
            if trials > most:
                return schedule
            try:
                broken = bool(run(candidate).violations)
            except Exception:
                broken = True
            if broken:
                schedule = candidate
                break
        else:
            return schedule


def simulate(
    seeds: Sequence[int], jobs: int, *, shrinks: bool = True, stop_after: int = 0
) -> list[tuple[int, Outcome]]:
    """Run seeds on processes, print progress, and return those that break an invariant."""
    begin, failed, latched, moved, done = time.monotonic(), [], 0, 0, 0
    kinds: collections.Counter[str] = collections.Counter()
    for seed, outcome in _outcomes(seeds, jobs):
        done += 1
        latched += bool(outcome.latched)
        moved += outcome.moved
        if outcome.violations:
            failed.append((seed, outcome))
            kinds[outcome.violations[0][:60]] += 1
            _say("")
            print(f"seed {seed}: {outcome.violations[0]}\n  replay: make simulate SEED={seed}", flush=True)
            if stop_after and len(failed) >= stop_after:
                break
        passed = time.monotonic() - begin
        _say(f"{done}/{len(seeds)} seeds, {len(failed)} failed, {passed * (len(seeds) - done) / done:.0f} s left")
    _say("")
    passed = time.monotonic() - begin
    print(
        f"{done} seeds in {passed:.0f} s on {jobs} processes: {moved} moved, {latched} latched, {len(failed)} broke an "
        "invariant"
    )
    if failed and shrinks:
        seed = failed[0][0]
        least = shrink(draw(seed))
        print(f"Seed {seed}, shrunk:\n\n{text(least)}\n{run(least).violations}")
    return failed


def _outcomes(seeds: Sequence[int], jobs: int) -> Iterator[tuple[int, Outcome]]:
    if jobs == 1:
        yield from map(trial, seeds)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context, max_tasks_per_child=_PER_PROCESS) as pool:
        yield from pool.map(trial, seeds, chunksize=1)


def _say(line: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)


def _range(value: str) -> range:
    first, _, last = value.rpartition(":")
    return range(int(first or 0), int(last))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 1 if an invariant was broken, 2 if a file is malformed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--seeds", type=_range, help="number of seeds, or first:end")
    what.add_argument("--seed", type=int, help="one seed, shown in full")
    what.add_argument("--schedule", help="file of one schedule, TOML or JSON")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes (default: one per core)")
    parser.add_argument("--no-shrink", action="store_true", help="do not shrink what fails")
    parser.add_argument("--stop-after", type=int, default=0, help="end after so many failed seeds")
    given: Any = parser.parse_args(arguments)
    if given.seeds is not None:
        return bool(simulate(given.seeds, given.jobs, shrinks=not given.no_shrink, stop_after=given.stop_after))
    try:
        schedule = draw(given.seed) if given.seed is not None else load(given.schedule)
    except DualUR10Error as error:
        print(error, file=sys.stderr)
        return 2
    outcome = run(schedule)
    print(text(schedule))
    for name, value in vars(outcome).items():
        print(f"{name}: {value}")
    if outcome.violations and not given.no_shrink:
        print(f"\nShrunk:\n\n{text(shrink(schedule))}")
    return bool(outcome.violations)


if __name__ == "__main__":
    sys.exit(main())
