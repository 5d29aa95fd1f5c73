"""Wheels in environments that hold them and what they need, linked from this one: nothing else is importable there."""

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from tests.alone import OWN, make, size_mb

ROOT = Path(__file__).parents[1]
FOLDERS = {
    "dual-ur10": ROOT,
    "ur-core": ROOT / "packages" / "ur-core",
    "ur-emulator": ROOT / "packages" / "ur-emulator",
}
WITHIN_S = 300.0


@pytest.fixture
def installed(wheel_of, tmp_path):
    """Function that installs wheels and what requirements need, and returns how to run a program there."""

    def install(names, *wanted):
        python = make(tmp_path / "venv", [*names, *wanted])
        (packages,) = (tmp_path / "venv").glob("lib/python*/site-packages")
        for name in names:
            zipfile.ZipFile(wheel_of(FOLDERS[name])).extractall(packages)

        def run(code):
            command = [str(python), "-I", "-c", code]
            home = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
            return subprocess.run(command, cwd=tmp_path, env=home, timeout=WITHIN_S, capture_output=True, text=True)

        return run

    return install


ABSENT = "from importlib.util import find_spec\nassert not [name for name in {} if find_spec(name)]\n"

CLIENT = """
import time
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
from ur_emulator.emulated_controller import EmulatedController

with EmulatedController("ur5e", plant="nominal") as robot:
    control, receive = RTDEControlInterface(robot.host), RTDEReceiveInterface(robot.host)
    q = receive.getActualQ()
    assert control.moveJ([*q[:5], q[5] + 0.3], 1.0, 2.0)
    assert abs(receive.getActualQ()[5] - q[5] - 0.3) < 2e-3
    q = receive.getActualQ()
    for step in range(100):
        begin = control.initPeriod()
        assert control.servoJ([*q[:5], q[5] + 1e-3 * step], 0.0, 0.0, 0.002, 0.1, 300.0)
        control.waitPeriod(begin)
    control.servoStop()
    assert 0.05 < receive.getActualQ()[5] - q[5] < 0.1
    robot.ask("stop", mode=3)
    robot.wait_for("safety_mode", 3)
    for _ in range(1000):
        if receive.getSafetyMode() == 3:
            break
        time.sleep(0.01)
    assert receive.getSafetyMode() == 3 and receive.isProtectiveStopped()
    control.disconnect()
print("moved and stopped")
"""


@pytest.mark.emulated
@pytest.mark.skipif(sys.version_info >= (3, 13), reason="ur_rtde has no wheels")
def test_an_unmodified_client_moves_an_arm_of_the_emulator_alone(installed):
    run = installed(["ur-core", "ur-emulator"], "ur-rtde")
    done = run(ABSENT.format(["dual_ur10", "gymnasium", "pinocchio", "scipy", "greenlet"]) + CLIENT)
    assert done.stdout.endswith("moved and stopped\n"), done.stderr


SUITE = """
import gymnasium as gym, numpy as np
import dual_ur10
from dual_ur10.policies import evaluate

gym.make_vec("DualUR10/SineTracking-v0", num_envs=2, vectorization_mode="vector_entry_point").reset(seed=0)
for task in ("SineTracking", "SyncCarry", "Handover"):
    for policy in ("scripted", "learned"):
        short = {"max_episode_steps": 20} if task == "SyncCarry" else {}  # whose physics is the slowest
        found = evaluate(f"DualUR10/{task}-v0", policy, episodes=1, env_kwargs=short)
        assert found.success_rate == (not short), (task, policy)
env = gym.make("DualUR10/Free-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
for path, extra in (
    ("dual_ur10.emulated", "emulator"),
    ("dual_ur10.envs.api.dm_env", "dm"),
    ("dual_ur10.policies.training.models", "train"),
):
    try:
        __import__(path)
    except dual_ur10.errors.MissingExtraError as error:
        assert f'pip install "dual-ur10[{extra}]"' in str(error), error
    else:
        raise AssertionError(path)
print("three tasks done")
"""


def test_the_suite_alone_runs_scripted_and_learned_policies(installed):
    run = installed(["ur-core", "dual-ur10"])
    done = run(ABSENT.format(["ur_emulator", "pinocchio", "scipy", "dm_env", "torch", "yaml", "rtde_control"]) + SUITE)
    assert done.stdout.endswith("three tasks done\n"), done.stderr


CORE = """
import numpy as np
from ur_core import kinematics
from ur_core.kinematics.robots import ROBOTS
assert len(ROBOTS) == 14
import ur_core.kernel, ur_core.servoj, ur_core.protocol.rtde, ur_core.links.rtde_link
ur_core.kernel.library()
print("loaded")
"""


def test_the_core_alone_needs_numpy(installed):
    done = installed(["ur-core"])(ABSENT.format(["dual_ur10", "ur_emulator", "mujoco", "pydantic"]) + CORE)
    assert done.stdout.endswith("loaded\n"), done.stderr


@pytest.mark.parametrize(("name", "most_mb"), [("ur-core", 62), ("ur-emulator", 150), ("dual-ur10", 170)])
def test_an_installation_is_small(wheel_of, name, most_mb):
    own = ["ur-core", name] if name != "ur-core" else [name]
    size = sum(
        each.file_size for each in (info for one in own for info in zipfile.ZipFile(wheel_of(FOLDERS[one])).infolist())
    )
    assert size_mb([name]) + size / 1e6 < most_mb


@pytest.mark.parametrize(
    ("changed", "module", "words"),
    [
        ("ur-core", "dual_ur10", "dual-ur10 0.1.0 needs ur-core 0.1.0, found 9.9.9"),
        ("ur-core", "ur_emulator", "ur-emulator 0.1.0 needs ur-core 0.1.0, found 9.9.9"),
        ("ur-emulator", "dual_ur10.emulated", "dual-ur10 0.1.0 needs ur-emulator 0.1.0, found 9.9.9"),
    ],
)
def test_mixed_versions_are_named(changed, module, words):
    package = changed.replace("-", "_")
    code = f"import {package}\n{package}.__version__ = '9.9.9'\nimport {module}\n"
    done = subprocess.run([sys.executable, "-c", code], timeout=WITHIN_S, capture_output=True, text=True)
    assert done.returncode == 1
    assert f"MixedVersionsError: {words}: pip install" in done.stderr


def test_own_distributions_need_each_other_in_one_version():
    for folder in FOLDERS.values():
        text = (folder / "pyproject.toml").read_text()
        project = tomllib.loads(text)["project"]
        own = "|".join(OWN)
        needs = [
            *project["dependencies"],
            *(each for extra in project["optional-dependencies"].values() for each in extra),
        ]
        for need in needs:
            found = re.match(rf"({own})(\[[\w,]+\])?(==[\d.]+)?", need)
            assert found is None or found[1] == project["name"] or found[3], need
