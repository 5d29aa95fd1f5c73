"""Scripts in processes of their own, forked from one that has imported what they need from other packages."""

import multiprocessing
import os
import runpy
import sys
import warnings
from multiprocessing.process import BaseProcess
from pathlib import Path

_WITHIN_S = 300.0
# Nothing of this package: a script has to import it, and what it registers is its own.
_IMPORTED = ["gymnasium", "matplotlib.figure", "minari", "mujoco", "pettingzoo", "pytest", "stable_baselines3"]

_forked = multiprocessing.get_context("forkserver")
_forked.set_forkserver_preload(_IMPORTED)


def _run(path: Path, arguments: tuple[str, ...], folder: Path, environment: dict[str, str], output: Path) -> None:
    os.chdir(folder)
    os.environ.update(environment)
    sys.argv[:] = [str(path), *arguments]
    sys.path.insert(0, str(path.parent))
    with output.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    warnings.simplefilter("ignore")
    runpy.run_path(str(path), run_name="__main__")


def start(path: Path, *arguments: str, folder: Path, output: Path, **environment: str) -> BaseProcess:
    """Start a script, see `run`."""
    process = _forked.Process(target=_run, args=(path, arguments, folder, environment, output))
    process.start()
    return process


def run(path: Path, *arguments: str, folder: Path, output: Path, **environment: str) -> str:
    """Run a script in a folder as `python PATH ARGUMENTS` does, and return what it prints.

    Args:
        path: The script.
        *arguments: Its arguments.
        folder: The folder that it runs in.
        output: File for what it prints.
        **environment: Further variables of its environment.

    Raises:
        AssertionError: It failed. What it printed is in the message.
    """
    process = start(path, *arguments, folder=folder, output=output, **environment)
    process.join(_WITHIN_S)
    if process.exitcode is None:
        process.kill()
        process.join()
    text = output.read_text() if output.exists() else ""
    assert process.exitcode == 0, text
    return text


def run_tests(tests: Path, *paths: Path, folder: Path) -> str:
    """Run a folder of tests with pytest, as `run` does a script, and return what it prints.

    Args:
        tests: Folder of the tests.
        *paths: Folders to import from before all others.
        folder: An empty folder to run in.

    Raises:
        AssertionError: A test failed.
    """
    script = folder / "run_tests.py"
    options = ["-q", "-p", "no:cacheprovider", "--rootdir", str(tests.parent), str(tests)]
    script.write_text(
        f"import sys, pytest\nsys.path[:0] = {[str(each) for each in paths]}\nsys.exit(pytest.main({options}))\n"
    )
    return run(script, folder=folder, output=folder / "output")
