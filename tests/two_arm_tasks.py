"""Installation of the example package `two_arm_tasks` into a folder, as pip does it, with its entry point."""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "examples" / "two_arm_tasks"


def install(target):
    """Install a copy of the package into a folder, without a network."""
    flags = ["--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--disable-pip-version-check"]
    with tempfile.TemporaryDirectory() as folder:
        source = shutil.copytree(FOLDER, Path(folder) / "source", ignore=shutil.ignore_patterns("__pycache__", "build"))
        command = [sys.executable, "-m", "pip", "install", *flags, "--target", str(target), str(source)]
        subprocess.run(command, check=True, timeout=120, capture_output=True)
