"""The emulator's README and pages: its fixture in another project, and its examples in processes of their own."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[4]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
SUITE = importlib.util.find_spec("dual_ur10") is not None


def blocks(page):
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)


CLIENT, CONFTEST, TESTS = blocks("packages/ur-emulator/README.md")
MORE = """
import os

pids = []


@pytest.mark.parametrize("ur_controller", [{"robot": "ur10"}], indirect=True)
@pytest.mark.ur_controller(robot="ur5", powered=False)
def test_the_nearest_option_counts(ur_controller):
    assert ur_controller.robot == "ur10"
    assert ur_controller.ask("state", names=["robot_mode"]) == {"robot_mode": 3}
    pids.append(ur_controller.process.pid)


def test_it_has_ended_with_its_test():
    with pytest.raises(ProcessLookupError):
        os.kill(*pids, 0)


@pytest.mark.ur_controller("ur3")
def test_an_option_has_a_name(ur_controller):
    pass
"""


@pytest.mark.emulated
def test_the_documented_fixture_runs_in_another_project(tmp_path):
    # Beside the fixtures of cells, which are a plugin, too.
    (tmp_path / "conftest.py").write_text(CONFTEST.replace("[", '["dual_ur10.testing", ' if SUITE else "["))
    (tmp_path / "test_it.py").write_text(TESTS + MORE)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")  # settings of no folder above
    command = [sys.executable, "-m", "pytest", "-q", "--strict-markers", "-p", "no:cacheprovider", "-W", "error"]
    found = subprocess.run(
        [*command, str(tmp_path)], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=240
    )
    assert "3 passed, 1 error" in found.stdout, found.stdout + found.stderr
    assert "the marker ur_controller has ('ur3',): name each option, as in robot='ur3e'" in found.stdout


@pytest.mark.emulated
@pytest.mark.real_time
@pytest.mark.parametrize(
    ("code", "printed"),
    [
        (CLIENT, r"wrist 3 moved by 0\.(?:499|500|501) rad\n"),
        *((code, "") for code in blocks("docs/reference/emulator.md")),
        *((code, r"{.*'safety_mode': 1}\n{.*}\n") for code in blocks("docs/reference/emulated-cell.md") if SUITE),
    ],
    ids=["client", "torques", "cell"][: 2 + SUITE],
)
def test_the_documented_examples_run(tmp_path, code, printed):
    pytest.importorskip("rtde_control")
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(printed, done.stdout), done.stdout
