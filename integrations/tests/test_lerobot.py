"""LeRobot's own programs, unmodified, with simulated and emulated arms: `make test-lerobot`."""

from __future__ import annotations

import importlib.metadata
import json
import os
import pty
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("lerobot")

HERE = Path(__file__).parent
ROBOT = ("--robot.type=dual_ur10", "--robot.images=[front]", "--robot.width=80", "--robot.height=64")
TELEOP = ("--teleop.type=dual_ur10", "--teleop.device=sway:Sway")
LIMIT_S = 300


@pytest.fixture(scope="session")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("lerobot")


@pytest.fixture(scope="session")
def environment(root):
    own = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(root / "hf"), "OMP_NUM_THREADS": "1", "XDG_STATE_HOME": str(root)}
    paths = os.pathsep.join([str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, **own, "PYTHONPATH": paths}


@pytest.fixture(scope="session")
def run(root, environment):
    """Run a program in a folder of its own, and return what it printed. Without a terminal unless keys are given."""

    def run(*arguments, keys=()):
        command = [sys.executable, *map(str, arguments)]
        if not keys:
            done = subprocess.run(
                command, cwd=root, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True,
                timeout=LIMIT_S,
            )  # fmt: skip
            text, code = done.stdout + done.stderr, done.returncode
        else:
            text, code = _with_keys(command, keys)
        print(text[-4000:])
        assert code == 0, text[-4000:]
        return text

    def _with_keys(command, keys):
        master, slave = pty.openpty()
        log = root / "keys.log"
        with log.open("wb") as output:
            process = subprocess.Popen(command, cwd=root, env=environment, stdin=slave, stdout=output, stderr=output)
            try:
                for word, key in keys:
                    _wait_for(log, word, process)
                    time.sleep(0.5)
                    os.write(master, key)
                process.wait(LIMIT_S)
                return log.read_text(), process.returncode
            finally:
                process.kill()
                process.wait()
                os.close(master)
                os.close(slave)

    return run


def _wait_for(log, word, process):
    end = time.monotonic() + LIMIT_S
    while word not in log.read_text():
        assert process.poll() is None, log.read_text()[-4000:]
        assert time.monotonic() < end
        time.sleep(0.1)


def script(name):
    return "-m", f"lerobot.scripts.lerobot_{name}"


def recorded(run, folder, *robot):
    run(
        *script("record"), *robot, *TELEOP, "--dataset.repo_id=local/recorded", f"--dataset.root={folder}",
        "--dataset.single_task=sway", "--dataset.fps=25", "--dataset.episode_time_s=2", "--dataset.reset_time_s=0.1",
        "--dataset.num_episodes=2", "--dataset.push_to_hub=false", "--play_sounds=false",
        "--dataset.rgb_encoder.vcodec=h264",
    )  # fmt: skip


@pytest.fixture(scope="session")
def exported(run, root):
    """A dataset of two episodes of Handover, with images."""
    run("-m", "dual_ur10", "rollout", "Handover", "--episodes", 2, "--randomization", "mild", "--record", root / "runs")
    run("-m", "dual_ur10", "export", "lerobot", root / "runs", "--out", root / "exported")
    run(
        "-m", "dual_ur10", "export", "lerobot", root / "runs", "--out", root / "pictured", "--cameras", "front",
        "--size", "80x64",
    )  # fmt: skip
    return root / "exported", root / "pictured"


@pytest.fixture(scope="session")
def simulated(run, root):
    """A dataset that LeRobot has recorded of simulated arms, with images."""
    recorded(run, root / "recorded", *ROBOT)
    return root / "recorded"


def test_lerobot_finds_the_distributions_by_their_names():
    names = {each.metadata["Name"] for each in importlib.metadata.distributions()}
    assert {f"lerobot_{kind}_dual_ur10" for kind in ("robot", "teleoperator", "env")} <= names


def test_cameras_that_would_have_one_name_are_refused():
    from lerobot_robot_dual_ur10 import DualUR10Robot, DualUR10RobotConfig

    from dual_ur10.errors import DatasetError

    with pytest.raises(DatasetError, match="'left/wrist' and 'left_wrist' would both be"):
        DualUR10Robot(DualUR10RobotConfig(images=["left/wrist", "left_wrist"]))


def test_lerobot_loads_exported_datasets(run, exported):
    for each in exported:
        assert "episodes are equal" in run(HERE / "load.py", each)


def test_lerobot_records_and_its_dataset_is_read_and_followed(run, simulated, root):
    assert "episodes are equal" in run(HERE / "load.py", simulated)
    text = run("-m", "dual_ur10", "import", "lerobot", simulated, "--no-record")
    assert text.count("commanded joints as in the dataset") == 2


def test_lerobot_replays(run, simulated, root):
    run(
        *script("replay"), "--robot.type=dual_ur10", f"--robot.record={root / 'replayed'}",
        "--dataset.repo_id=local/recorded", f"--dataset.root={simulated}", "--dataset.episode=1",
        "--play_sounds=false",
    )  # fmt: skip
    from dual_ur10.lerobot.dataset_reader import read_dataset
    from dual_ur10.sim2real.recording.reader import read_run

    (episode,) = read_run(next((root / "replayed").iterdir())).episodes
    targets = read_dataset(simulated).episode(1)["action"].reshape(-1, 2, 7)[..., :6]
    commands = episode.action.reshape(-1, 2, 7)[..., :6]
    away = abs(targets[:, None] - commands[None]).max(axis=(2, 3)).min(axis=1)
    assert away.max() < 2e-3  # between two steps, whose clock is another one than LeRobot's


def test_lerobot_evaluates(run, exported, root):
    run(HERE / "make_policy.py", exported[0], root / "state_policy")
    run(
        *script("eval"), f"--policy.path={root / 'state_policy'}", "--env.type=dual_ur10", "--env.task=Handover",
        "--env.episode_length=30", "--env.settings={randomization: mild}", "--eval.n_episodes=2",
        "--eval.batch_size=2", "--policy.device=cpu", f"--output_dir={root / 'evaluated'}",
    )  # fmt: skip
    found = json.loads((root / "evaluated" / "eval_info.json").read_text())
    assert found["overall"]["n_episodes"] == 2


@pytest.mark.parametrize("camera", ["", "front"])
def test_lerobot_loads_and_evaluates_a_checkpoint_of_act(run, root, camera):
    policy = root / f"act{camera}"
    run(HERE / "make_act.py", policy, *filter(None, [camera]))
    assert "20 chunks of LeRobot are those of dual_ur10" in run(HERE / "load_policy.py", policy)
    run(
        *script("eval"), f"--policy.path={policy}", "--env.type=dual_ur10", "--env.task=Handover",
        "--env.episode_length=30", "--env.settings={randomization: mild}", "--eval.n_episodes=2",
        "--eval.batch_size=2", "--policy.device=cpu", f"--output_dir={policy}_evaluated",
        *(["--env.images=[front]", "--env.width=80", "--env.height=64"] if camera else []),
    )  # fmt: skip


ROLLOUT = ("--fps=25", "--task=sway", "--policy.device=cpu", "--play_sounds=false")


@pytest.fixture(scope="session")
def policy(run, exported, root):
    run(HERE / "make_policy.py", exported[1], root / "image_policy")
    return f"--policy.path={root / 'image_policy'}"


def test_lerobot_rolls_out_a_policy_of_images(run, policy):
    """Also its drive back to where the arms began, through the gate."""
    text = run(*script("rollout"), policy, *ROBOT, "--strategy.type=base", "--duration=3", *ROLLOUT)
    assert "Returning robot to initial position" in text
    assert "Rollout finished" in text


def test_a_person_corrects_a_policy_in_lerobots_dagger(run, policy, root):
    """With the clutch's handover: it pauses, corrects and goes on by the keys of a terminal."""
    data = root / "rollout_corrected"
    run(
        *script("rollout"), policy, *ROBOT, *TELEOP, "--strategy.type=dagger", "--strategy.num_episodes=1",
        "--strategy.smooth_handover=false", "--duration=20", *ROLLOUT, "--dataset.repo_id=local/rollout_corrected",
        f"--dataset.root={data}", "--dataset.single_task=sway", "--dataset.fps=25", "--dataset.push_to_hub=false",
        "--dataset.rgb_encoder.vcodec=h264",
        keys=[("recording started", b" "), ("autonomous -> paused", b"\t"), ("paused -> correcting", b"\t")],
    )  # fmt: skip
    from dual_ur10.lerobot.dataset_reader import read_dataset

    found = read_dataset(data)
    assert found.columns["intervention"].all()


@pytest.fixture
def cell(root, environment):
    """Cell file of two emulated controllers."""
    file = root / "cell.toml"
    command = [sys.executable, "-m", "dual_ur10", "emulate", "--task", "Free", "--cell", str(file)]
    process = subprocess.Popen(command, cwd=root, env=environment, stdout=subprocess.DEVNULL)
    try:
        end = time.monotonic() + LIMIT_S
        while not file.exists():
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.1)
        yield file
    finally:
        process.terminate()
        process.wait(LIMIT_S)


def test_lerobot_records_and_replays_on_the_emulated_cell(run, cell, root):
    robot = ("--robot.type=dual_ur10", f"--robot.cell={cell}")
    recorded(run, root / "emulated", *robot)
    assert "episodes are equal" in run(HERE / "load.py", root / "emulated")
    run(
        *script("replay"), *robot, "--dataset.repo_id=local/recorded", f"--dataset.root={root / 'emulated'}",
        "--dataset.episode=0", "--play_sounds=false",
    )  # fmt: skip
