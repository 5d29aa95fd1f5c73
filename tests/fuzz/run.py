"""Coverage-guided fuzzing with atheris: `make fuzz`, or `python -m tests.fuzz.run --help`.

Each target runs in a process of its own. It begins with its seeds and its committed corpus, and keeps what reaches new
code in `out/fuzz/corpus/<target>`. An input that ends it is written to `out/fuzz/found/<target>`: an unexpected
exception, a hang, or too much memory. `--merge` replaces the committed corpora by the smallest ones that reach the same
code as all that was kept.
"""

from __future__ import annotations

import argparse
import json
import logging
import re
import secrets
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
OUT = ROOT / "out" / "fuzz"
CORPUS = FOLDER / "corpus"

ARITHMETIC = [
    *("dual_ur10.assets", "dual_ur10.envs", "ur_core.kinematics", "dual_ur10.sim2real.control"),
    *(f"ur_emulator.{each}" for each in ("controller", "motion", "safety", "rtde_variables")),
]
HANG_S = 10
MEMORY_MB = 1024
MOST_RUNS = (
    1_000_000  # of one process: with some targets the memory of the fuzzer grows, though that of readers does not
)
LONGEST_KEPT = 512  # bytes of an input in the committed corpora


def fuzz(name: str, arguments: list[str]) -> None:
    """Fuzz one target in this process, which ends with it."""
    import atheris

    # Only readers guide the search: instrumented arithmetic would cost more than it tells.
    with atheris.instrument_imports(include=["dual_ur10", "ur_emulator"], exclude=ARITHMETIC):
        from tests.fuzz.targets import TARGETS
    logging.disable()
    atheris.Setup([str(command_of(name)), *arguments], TARGETS[name])
    atheris.Fuzz()


def command_of(name: str) -> Path:
    """Return an executable file that fuzzes a target: merging starts it again for every input that ends it."""
    path = OUT / f"{name}.sh"
    OUT.mkdir(parents=True, exist_ok=True)
    path.write_text(
        f"#!/bin/sh\ncd {shlex.quote(str(ROOT))} && exec {shlex.quote(sys.executable)} -m tests.fuzz.run --in-process "
        f'{name} "$@"\n'
    )
    path.chmod(0o755)
    return path


def folders(name: str) -> tuple[Path, Path, Path]:
    """Return the committed corpus, the growing one with the seeds, and the folder of what is found."""
    from tests.fuzz.seeds import SEEDS

    made = CORPUS / name, OUT / "corpus" / name, OUT / "found" / name
    for each in made:
        each.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(SEEDS[name]):
        (made[1] / f"seed-{number}").write_bytes(data)
    return made


def run(name: str, *, runs: int, seconds: int, seed: int) -> dict[str, Any]:
    """Fuzz one target for so many executions or seconds; 0: no limit. Return what became of it."""
    from tests.fuzz.targets import TARGETS

    target = TARGETS[name]
    committed, growing, found = folders(name)
    words = OUT / f"{name}.dict"
    escaped = ("".join(f"\\x{byte:02x}" for byte in word.encode()) for word in target.words)
    words.write_text("".join(f'"{each}"\n' for each in escaped))
    result: dict[str, Any] = {"target": name, "executions": 0, "seconds": 0.0, "peak_mb": 0, "ok": True}
    begin = time.monotonic()
    (OUT / f"{name}.log").unlink(missing_ok=True)
    while result["ok"]:
        left_s = seconds - int(result["seconds"]) if seconds else 0
        left = min(runs - result["executions"], MOST_RUNS) if runs else MOST_RUNS
        if left <= 0 or (seconds and left_s <= 0):
            break
        arguments = [
            f"-seed={seed}",
            f"-runs={left}",
            f"-max_total_time={left_s}",
            f"-max_len={target.longest}",
            f"-timeout={HANG_S}",
            f"-rss_limit_mb={MEMORY_MB}",
            f"-artifact_prefix={found}/",
            "-print_final_stats=1",
            *([f"-dict={words}"] if target.words else []),
            str(growing),
            str(committed),
        ]
        done = subprocess.run([command_of(name), *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        text = done.stdout.decode("utf-8", "replace")
        with (OUT / f"{name}.log").open("a") as log:
            log.write(text)
        if done.returncode:
            sys.stderr.write(text[max(0, text.find("Uncaught Python exception")) :][-4000:])
        stats = dict(re.findall(r"stat::(\w+):\s+(\d+)", text))
        result["ok"] = not done.returncode and bool(stats)
        result["executions"] += int(stats.get("number_of_executed_units", 0))
        result["seconds"] = round(time.monotonic() - begin, 1)
        result["peak_mb"] = max(result["peak_mb"], int(stats.get("peak_rss_mb", 0)))
        seed += 1
    return result


def merge(name: str) -> None:
    """Replace the committed corpus of a target by the smallest one that reaches all that its inputs reach."""
    committed, growing, _ = folders(name)
    small = OUT / "merged" / name
    shutil.rmtree(small, ignore_errors=True)
    small.mkdir(parents=True)
    arguments = ["-merge=1", f"-max_len={LONGEST_KEPT}", str(small), str(committed), str(growing)]
    subprocess.run([command_of(name), *arguments], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    shutil.rmtree(committed)
    shutil.move(small, committed)


def main() -> int:
    """Run the command line."""
    from tests.fuzz.targets import TARGETS

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", help="names; none: all of them")
    parser.add_argument("--runs", type=int, default=0, help="executions per target; 0: no limit")
    parser.add_argument("--seconds", type=int, default=0, help="time per target; 0: no limit")
    parser.add_argument("--seed", type=int, help="seed of the mutations; by default another one each time")
    parser.add_argument("--merge", action="store_true", help="replace the committed corpora instead")
    options = parser.parse_args()
    names = options.targets or list(TARGETS)
    if unknown := set(names) - set(TARGETS):
        parser.error(f"unknown targets {', '.join(sorted(unknown))}: there are {', '.join(TARGETS)}")
    if options.merge:
        for name in names:
            merge(name)
        return 0
    if options.runs <= 0 and options.seconds <= 0:
        parser.error("give --runs or --seconds, above 0")
    seed = secrets.randbelow(2**31) + 1 if options.seed is None else options.seed
    print(
        f"Mutations are drawn with seed {seed}: make fuzz SEED={seed} draws the same from the same corpus.", flush=True
    )
    results = []
    for name in names:
        results.append(run(name, runs=options.runs, seconds=options.seconds, seed=seed))
        last = results[-1]
        rate = last["executions"] / max(last["seconds"], 1e-9)
        end = "ok" if last["ok"] else f"FAILED: {OUT}/{name}.sh FILE replays an input of {OUT}/found/{name}"
        print(
            f"{name:20} {last['executions']:>11,} executions {last['seconds']:>8} s {rate:>8,.0f}/s "
            f"{last['peak_mb']:>5} MB  {end}",
            flush=True,
        )
    (OUT / "results.json").write_text(json.dumps(results, indent=1))
    total, seconds = (sum(each[key] for each in results) for key in ("executions", "seconds"))
    print(f"{'all':20} {total:>11,} executions {seconds:>8.1f} s")
    return 0 if all(each["ok"] for each in results) else 1


if __name__ == "__main__":
    if sys.argv[1:2] == ["--in-process"]:
        fuzz(sys.argv[2], sys.argv[3:])
    else:
        sys.exit(main())
