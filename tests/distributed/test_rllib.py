"""Training on Ray RLlib with two workers on this machine: `make test-rllib`."""

import ipaddress
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import psutil
import pytest

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "rllib_two_agents.py"
LIMIT_S = 240.0
LOOK_S = 0.25
LEAVE_S = 20.0

pytestmark = pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra 'rllib': make test-rllib")


class Watched:
    """A script in a process of its own, and all that it starts, known by the folder in their environment.

    Attributes:
        addresses: IP addresses on which any of them listened.
        workers: Names of Ray's actors, by process.
        output: What the script said.
    """

    def __init__(self, script, *arguments, home):
        # Ray's sockets are in it: the path must be short.
        self._folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")
        self._environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")} | {
            "HOME": str(home),
            "PYTHONPATH": str(EXAMPLE.parent),
            "PYTHONUNBUFFERED": "1",
            "PYTHONWARNINGS": "ignore",
            "RAY_TMPDIR": self._folder,
        }
        self.addresses, self.workers = set(), {}
        try:
            self._run([sys.executable, str(script), *arguments], home / "output.txt")
            self.left = self._left()
        finally:
            for process in self._processes():
                process.kill()
            shutil.rmtree(self._folder, ignore_errors=True)

    def _run(self, command, path):
        with path.open("w") as file:
            process = subprocess.Popen(
                command, cwd=path.parent, env=self._environment, stdout=file, stderr=subprocess.STDOUT
            )
        end = time.monotonic() + LIMIT_S
        while process.poll() is None and time.monotonic() < end:
            self._look()
            time.sleep(LOOK_S)
        self.output = path.read_text()
        assert process.poll() == 0, self.output
        assert self.addresses
        assert all(ipaddress.ip_address(each).is_loopback for each in self.addresses), self.addresses

    def _processes(self):
        found = []
        for process in psutil.process_iter():
            try:
                if process.environ().get("RAY_TMPDIR") == self._folder and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
            except psutil.Error:
                continue
        return found

    def _look(self):
        for process in self._processes():
            try:
                name = process.cmdline()[0]
                listening = [each for each in process.net_connections() if each.status == psutil.CONN_LISTEN]
            except (psutil.Error, IndexError):
                continue
            self.addresses |= {each.laddr.ip.removeprefix("::ffff:") for each in listening}
            if "EnvRunner" in name:
                self.workers[process.pid] = name

    def _left(self):
        end = time.monotonic() + LEAVE_S
        while (left := self._processes()) and time.monotonic() < end:
            time.sleep(LOOK_S)
        return [" ".join(each.cmdline()) for each in left]


@pytest.mark.parametrize(("way", "names"), [("two", ["left", "right"]), ("joint", ["both"])])
def test_the_example_trains_on_two_workers_of_this_machine_and_leaves_nothing(way, names, tmp_path):
    found = Watched(EXAMPLE, "2", way, home=tmp_path)  # no episode ends in the first batch
    assert found.left == []
    assert len(found.workers) == 2, found.workers
    (line,) = re.findall(r"^2 \{(.*)\}$", found.output, re.MULTILINE)
    returns = {name: float(value) for name, value in re.findall(r"'(\w+)': ([^,]+)", line)}
    assert sorted(returns) == names
    assert all(math.isfinite(value) for value in returns.values())


@pytest.fixture(scope="module")
def changes(tmp_path_factory):
    home = tmp_path_factory.mktemp("changes")
    watched = Watched(Path(__file__).parent / "changes.py", str(home / "changes.json"), home=home)
    assert watched.left == []
    return json.loads((home / "changes.json").read_text())


@pytest.mark.parametrize(
    ("way", "policies"),
    [("two_agents", ["left", "right"]), ("either", ["either"]), ("joint_policy", ["default_policy"])],
)
def test_every_policy_learns_and_the_workers_on_two_nodes_get_it(changes, way, policies):
    found = changes[way]
    assert sorted(found["largest"]) == policies
    assert all(change > 0.0 for change in found["largest"].values()), found
    assert found["finite"]
    assert len(found["nodes"]) == len(found["processes"]) == 2
    assert changes["driver"] not in found["processes"]
    assert found["runners have them"] == [True, True]
