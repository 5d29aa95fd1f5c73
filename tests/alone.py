"""Environments that hold one distribution and what it needs, linked from those of this one: no network, no copies.

    python -m tests.alone FOLDER REQUIREMENT ... [--source FOLDER ...]

Tests of a distribution run in such an environment, where an import of what it does not need fails.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement

OWN = ("ur-core", "ur-emulator", "dual-ur10")


def built_of(root: Path, kind: str, out: Path) -> Path:
    """Build the distribution of a folder, "wheel" or "sdist", into an empty folder, and return its path."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(out)]
    subprocess.run(command, cwd=root, check=True, timeout=300, capture_output=True)
    (path,) = out.iterdir()
    return path


def closure(wanted: Sequence[str]) -> dict[str, Distribution]:
    """Return all distributions that requirements need, by name, as they are installed here."""
    found: dict[str, Distribution] = {}
    done: set[tuple[str, str]] = set()
    todo = [Requirement(each) for each in wanted]
    while todo:
        each = todo.pop()
        name = each.name.lower().replace("_", "-")
        found.setdefault(name, distribution(name))
        for extra in ("", *each.extras):
            if (name, extra) in done:
                continue
            done.add((name, extra))
            needs = map(Requirement, found[name].requires or ())
            todo += [need for need in needs if need.marker is None or need.marker.evaluate({"extra": extra})]
    return found


def files(found: Distribution) -> Iterator[Path]:
    """Yield the files of a distribution below the folder of packages, relative to it: no scripts, no bytecode."""
    for each in found.files or ():
        if each.parts[0] != ".." and "__pycache__" not in each.parts:
            yield Path(each)


def size_mb(wanted: Sequence[str]) -> float:
    """Return the size of what requirements need of others, in MB, as files of an installation without bytecode."""
    others = [each for name, each in closure(wanted).items() if name not in OWN]
    return sum(Path(each.locate_file(name)).stat().st_size for each in others for name in files(each)) / 1e6


def make(home: Path, wanted: Sequence[str], sources: Sequence[Path] = ()) -> Path:
    """Make an environment, and return its Python.

    Args:
        home: Folder of the environment. What is there is removed.
        wanted: Requirements. The distributions of this repository are not linked: see `sources`.
        sources: Folders whose packages are importable there.
    """
    shutil.rmtree(home, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(home)], check=True, timeout=120)
    python = home / "bin" / "python"
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(home), "platbase": str(home)}))
    for name, each in closure(wanted).items():
        if name in OWN:
            continue
        for file in files(each):
            target = packages / file
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(each.locate_file(file), target)
            except FileExistsError:
                continue  # of two distributions
            except OSError:
                shutil.copyfile(each.locate_file(file), target)
    if sources:
        (packages / "sources.pth").write_text("".join(f"{each.resolve()}\n" for each in sources))
    return python


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("requirement", nargs="+")
    parser.add_argument("--source", type=Path, nargs="*", default=())
    given = parser.parse_args()
    make(given.folder, given.requirement, given.source)
