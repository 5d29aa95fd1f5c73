"""Calls of other client libraries against emulated controllers, as a table.

    python benchmarks/clients.py --python PYTHON [--page docs/reference/clients.md] [--json FILE]

`PYTHON` is that of a virtual environment with the libraries, as `make clients` makes it. Each library meets a CB3 and
an e-Series controller in remote control, urkit an e-Series one only. A call works if it returns, has its effect where
that can be read back, and no program that it sent was refused. `--page` writes the table between the marks of a page.
"""

import argparse
import json
import os
import pathlib
import re
import select
import subprocess
import sys
import tempfile
import time

from dual_ur10.emulated.emulated_cell import EmulatedCell

WORKER = pathlib.Path(__file__).parent / "workers" / "client_worker.py"
LIBRARIES = {
    "ur-rtde": ("cb3", "e-series"),
    "urx": ("cb3", "e-series"),
    "universal-robots-clients": ("cb3", "e-series"),
    "urkit": ("e-series",),
}
TITLES = {"cb3": "CB3", "e-series": "e-Series"}
REFUSED = re.compile(r"(?:program is refused|program stopped|not started): (.*)")
MARKS = "<!-- made by make clients -->", "<!-- end -->"
CALL_S, LOGGED_S = 60.0, 0.3


class Stuck(Exception):  # noqa: N818  # a result, not an error
    """A call that did not return."""


class Worker:
    """One library that calls one controller.

    Args:
        python: Python that has the library.
        library: Its name.
        host: Address of the controller.
    """

    def __init__(self, python: str, library: str, host: str) -> None:
        self._process = subprocess.Popen(
            [os.path.abspath(python), "-P", str(WORKER), library, host],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=tempfile.gettempdir(),  # one of them writes a log where it runs
            env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        )
        self.about = self._answer()

    def _answer(self):
        if not select.select([self._process.stdout], [], [], CALL_S)[0]:
            raise Stuck(f"it did not return within {CALL_S:g} s")
        line = self._process.stdout.readline()
        if not line:
            raise Stuck("its process has ended")
        return json.loads(line)

    def call(self, name):
        """Make a call, and return what went wrong."""
        self._process.stdin.write(f"{name}\n")
        self._process.stdin.flush()
        return self._answer()["error"]

    def close(self):
        """End it."""
        self._process.kill()
        self._process.wait()


def tried(python, library, family):
    """Return the version of a library, and what went wrong with each of its calls."""
    with tempfile.NamedTemporaryFile(suffix=".log") as log, EmulatedCell(family=family, log=log.name) as cell:
        cell.wait_until("left", "robot_mode", 7)
        if family == "e-series":
            cell.ask("remote", arm="left", on=True)
        read = 0
        results, version = {}, ""
        worker = None
        try:
            worker = Worker(python, library, cell.left)
            version = worker.about["version"]
            if worker.about["error"]:
                results["(connecting)"] = worker.about["error"]
            for name in worker.about["calls"]:
                error = worker.call(name)
                time.sleep(LOGGED_S)
                text = pathlib.Path(log.name).read_text()
                refused, read = REFUSED.findall(text[read:]), len(text)
                results[name] = f"refused: {refused[0]}" if refused else error
                print(f"{library} {family} {name}: {results[name] or 'works'}", file=sys.stderr)
        except Stuck as error:
            results[name if results else "(connecting)"] = str(error)
        finally:
            if worker is not None:
                worker.close()
    return version, results


def rows_of(found):
    """Return the rows of the table."""
    yield "| client | controller | works | does not |"
    yield "|---|---|---|---|"
    for (library, family), (version, results) in found.items():
        works = ", ".join(f"`{name}`" for name, error in results.items() if not error)
        fails = "; ".join(f"`{name}`: {error.splitlines()[0][:160]}" for name, error in results.items() if error)
        fails = fails.replace("|", "\\|")
        yield f"| {library} {version} | {TITLES[family]} | {works or '–'} | {fails or '–'} |"


def main() -> None:
    """Try all, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", required=True, help="Python that has the libraries")
    parser.add_argument("--only", choices=tuple(LIBRARIES), help="one library")
    parser.add_argument("--page", type=pathlib.Path, help="page whose table is replaced")
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()
    found = {
        (library, family): tried(args.python, library, family)
        for library, families in LIBRARIES.items()
        if args.only in (None, library)
        for family in families
    }
    table = "\n".join(rows_of(found))
    print(table)
    if args.page:
        before, rest = args.page.read_text().split(MARKS[0])
        args.page.write_text(f"{before}{MARKS[0]}\n{table}\n{MARKS[1]}{rest.split(MARKS[1])[1]}")
    if args.json:
        rows = {f"{library} {version} {family}": each for (library, family), (version, each) in found.items()}
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
