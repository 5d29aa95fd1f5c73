"""Checkpoints in environments with another signature."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from safetensors.numpy import save as serialised

import dual_ur10
from dual_ur10 import policies
from dual_ur10.envs.core.randomization import PRESETS, VISUAL
from dual_ur10.envs.core.setup import load_task
from dual_ur10.errors import CheckpointError, SettingsError, UnknownNameError
from dual_ur10.policies.learned import checkpoint
from tests.policies.learned.checkpoints import (
    CARRY,
    HANDOVER,
    SINE,
    content,
    edit,
    exchange_weights,
    parts,
    put,
    sealed,
)


@pytest.mark.parametrize(
    ("env_id", "keywords", "message"),
    [
        (CARRY, {}, "is of DualUR10/SineTracking-v0"),
        (SINE, {"observation": "goals"}, "view 'state', the environment has 'goals': pass .* observation='state'"),
        (SINE, {"policy_rate_hz": 12.5}, "period_ticks 5, the environment has 10: pass .* policy_rate_hz=25.0"),
        (SINE, {"action_latency_ticks": 0}, "latency_ticks 5, the environment has 0: pass .* action_latency_ticks=5"),
        (SINE, {"action_mode": "joint_position"}, "actions.mode 'joint_delta', the environment has 'joint_position'"),
        (SINE, {"compensate_lag": False}, "compensate_lag True, the environment has False"),
        (SINE, {"cell": dual_ur10.CellConfig(speed_rad_s=0.9)}, "joint_step_rad"),
        (SINE, {"cell": dual_ur10.CellConfig(servoj=dual_ur10.ServojProfile(lookahead_s=0.05))}, "lookahead_s"),
        (SINE, {"cell": dual_ur10.CellConfig(servoj=dual_ur10.ServojProfile(gain=1500))}, "gain"),
        (SINE, {"cell": dual_ur10.CellConfig(servoj=dual_ur10.ServojProfile("e-series"))}, "robot.model 'UR10'"),
    ],
)
def test_a_checkpoint_of_another_environment(saved: Path, env_id: str, keywords: dict[str, Any], message: str) -> None:
    keywords = {"action_latency_ticks": 5, **keywords}
    with pytest.raises(CheckpointError, match=message):
        policies.load(saved, env_id, **keywords)
    if "policy_rate_hz" not in keywords:
        env = gym.make(env_id, **keywords)
        with pytest.raises(CheckpointError):
            checkpoint.load(saved, env)
        env.close()


@pytest.mark.parametrize("agents", ["joint", "shared"])
def test_a_checkpoint_of_the_concise_view(tmp_path: Path, agents: str) -> None:
    networks, made = parts(HANDOVER, agents, observation="goals")
    checkpoint.save(tmp_path / "x", networks, made)
    assert made.signature.kwargs["observation"] == made.signature.view == "goals"
    env = gym.make(HANDOVER, observation="goals")
    policy = checkpoint.load(tmp_path / "x", env)
    assert env.action_space.contains(policy(env.reset(seed=0)[0]))
    assert checkpoint.load(tmp_path / "x").sha256 == policy.sha256  # its own keywords make the same view
    with pytest.raises(CheckpointError, match=r"view 'goals', the environment has 'state': .*observation='goals'"):
        checkpoint.load(tmp_path / "x", HANDOVER)
    for view in ("goals", "both", "pixels", "flat"):
        with pytest.raises(SettingsError, match=f"{view}.*scripted policies read all fields"):
            policies.load("scripted", HANDOVER, observation=view)
    env.close()


def test_illegal_keywords_are_refused(saved: Path) -> None:
    with pytest.raises(UnknownNameError, match="colour"):
        policies.load(saved, SINE, colour="red")
    with pytest.raises(SettingsError):
        policies.load(saved, SINE, policy_rate_hz=33.0)
    with pytest.raises(UnknownNameError):
        policies.load(saved, "DualUR10/Juggling-v0")


@pytest.mark.parametrize("version", ["0.2.0", "1.1.0", "0.10.0", "9.9"])
def test_a_checkpoint_of_another_version(version: str, saved: Path) -> None:
    edit(saved, lambda value: value["versions"].update(dual_ur10=version))
    with pytest.raises(CheckpointError, match=f"made with dual_ur10 {version}, this is {dual_ur10.__version__}"):
        checkpoint.load(saved)
    edit(saved, lambda value: value["versions"].update(dual_ur10=f"{dual_ur10.__version__.rpartition('.')[0]}.99"))
    checkpoint.load(saved)


@pytest.mark.parametrize(
    ("path", "new"),
    [
        (("env_id",), HANDOVER),
        (("env_id",), "CartPole-v1"),
        (("view",), "goals"),
        (("view",), "pixels"),
        (("rate", "tick_s"), 0.002),
        (("rate", "period_ticks"), 4),
        (("rate", "latency_ticks"), 4),
        (("actions", "mode"), "tcp_delta"),
        (("actions", "gripper"), True),
        (("actions", "compensate_lag"), False),
        (("actions", "joint_step_rad", 3), 0.05),
        (("actions", "joint_step_rad"), []),
        (("robot", "model"), "UR6"),
        (("robot", "model"), "UR10 + UR10 + UR10"),
        (("robot", "model"), "UR10e"),
        (("robot", "family"), "e-series"),
        (("robot", "lookahead_s"), 0.04),
        (("robot", "gain"), 1999.0),
        (("observation", "low", 5), -6.4),
        (("observation", "high", 5), 6.4),
        (("observation", "dtype"), "float32"),
        (("observation", "shape", 0), 66),
        (("action", "low", 11), -0.9),
        (("action", "high", 0), 0.9),
        (("action", "dtype"), "float64"),
    ],
)
def test_a_false_signature_is_refused(path: tuple[Any, ...], new: Any, saved: Path) -> None:
    """Every single wrong value is refused, although all others are right."""
    (saved / "manifest.json").write_bytes(sealed(put(content(saved), ("signature", *path), new)))
    with pytest.raises(CheckpointError):
        policies.load(saved, SINE, action_latency_ticks=5, amplitude_m=0.08)
    if path[-1] not in ("lookahead_s", "gain"):  # of which an environment of its own can be made
        with pytest.raises(CheckpointError):
            checkpoint.load(saved)


def test_the_networks_of_two_agents_must_fit_their_observations(tmp_path: Path) -> None:
    networks, made = parts(SINE, "shared")
    checkpoint.save(tmp_path / "x", networks, made)
    edit(tmp_path / "x", lambda value: value["network"].update(layers=[40, 4, 6]))
    edit(tmp_path / "x", lambda value: value.update(normalisers=[]))
    exchange_weights(
        tmp_path / "x",
        serialised(
            {
                "policy.0.weight": np.zeros((4, 40), np.float32),
                "policy.0.bias": np.zeros(4, np.float32),
                "policy.1.weight": np.zeros((6, 4), np.float32),
                "policy.1.bias": np.zeros(6, np.float32),
            }
        ),
    )
    with pytest.raises(CheckpointError, match="40 inputs: shared observations have 47"):
        checkpoint.load(tmp_path / "x")


def test_a_narrower_range_of_objects_lies_within_the_training(caplog: pytest.LogCaptureFixture) -> None:
    """Handover's policy learned with the ranges of "wide", which are 1.5 times the default ones."""
    handover = "DualUR10/Handover-v0"
    with caplog.at_level(logging.WARNING):
        for keywords in ({}, {"object_range_m": 0.01}, {"randomization": "wide"}):
            policies.load("learned", handover, action_latency_ticks=5, **keywords)
        assert not caplog.records
        policies.load("learned", handover, action_latency_ticks=5, object_range_m=0.04, success_turn_rad=0.1)
    (record,) = caplog.records
    assert record.message.endswith("object_range_m was 0.03 and is 0.04; success_turn_rad was 0.15 and is 0.1")


# Values of each keyword within and outside the range of a training with the keywords of `_TRAINED`.
_TRAINED: dict[str, dict[str, Any]] = {
    SINE: {"random_path": True},
    CARRY: {},
    HANDOVER: {"giver": "random"},
}
_RANGES: dict[str, dict[str, tuple[list[Any], list[Any]]]] = {
    SINE: {
        "axis": (["z", (1.0, 1.0, 0.0)], []),
        "amplitude_m": ([0.02, 0.12], [0.01, 0.13]),
        "frequency_hz": ([0.2, 0.8], [0.1]),
        "duration_s": ([], [10.0]),
        "soft_start_s": ([], [4.0]),
        "phase_rad": ([1.0], []),
        "center_m": (
            [((0.05, 0.65, 0.35), (-0.05, -0.55, 0.45))],
            [((0.0, 0.66, 0.4), (0.0, -0.6, 0.4)), ((0.0, 0.6, 0.4), (0.0, -0.6, 0.34))],
        ),
        "randomize": ([False], []),
        "random_path": ([True], []),
        "arms": ([], ["left"]),
        "success_rms_m": ([], [0.002]),
    },
    CARRY: {
        "duration_s": ([], [60.0]),
        "grasp": ([], []),  # other spaces, so refused
        "payload": ([], ["unknown"]),
        "grip_force_n": ([], [80.0]),
        "path_speed": ([], []),  # other spaces, so refused
        "object_range_m": ([0.0, 0.02], [0.021]),
        "object_turn_rad": ([0.0, 0.05], [0.051]),
        "success_error_m": ([], [0.011]),
        "success_turn_rad": ([], [0.06]),
        "success_slip_m": ([], [0.004]),
    },
    HANDOVER: {
        "giver": (["right", "random"], []),
        "duration_s": ([], [19.0]),
        "grip_force_n": ([], [61.0]),
        "object_range_m": ([0.0], [0.021]),
        "object_turn_rad": ([0.0], [0.53]),
        "target_range_m": ([0.0], [0.031]),
        "target_turn_rad": ([0.0], [0.31]),
        "success_error_m": ([], [0.016]),
        "success_turn_rad": ([], [0.16]),
    },
}


@pytest.mark.parametrize("env_id", _RANGES)
def test_a_warning_names_each_value_that_leaves_the_range_of_the_training(
    env_id: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Every keyword of the task and every range of the randomization, one at a time."""
    checkpoint.save(tmp_path / "x", *parts(env_id, "shared", **_TRAINED[env_id]))
    ranges = _RANGES[env_id]
    settings = load_task(env_id).settings_type
    assert [*ranges] == [each.name for each in dataclasses.fields(settings)], "a keyword has no values here"

    def warnings(**keywords: Any) -> list[str]:
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            policies.load(tmp_path / "x", env_id, **keywords)
        return [record.message.rpartition("perform worse: ")[2] for record in caplog.records]

    for name, (within, outside) in ranges.items():
        assert [warnings(**{name: value}) for value in within] == [[]] * len(within), name
        for value in outside:
            (text,) = warnings(**{name: value})
            assert text.startswith(f"{name} was ")
            assert ";" not in text
    mild, most = dataclasses.asdict(PRESETS["mild"]), dataclasses.asdict(PRESETS["wide"])
    without = {"object_spread", *VISUAL}  # shows as the ranges that it widens; numbers are observed
    if env_id == SINE:
        without |= {name for name in mild if name.startswith(("object_", "grip_"))}
    for name in {*mild} - without:
        assert warnings(randomization={name: mild[name]}) == []
        (text,) = warnings(randomization={name: most[name]})
        assert text.startswith(f"randomization {name} was ")
        assert ";" not in text
    if env_id != SINE:
        (text,) = warnings(randomization={"object_spread": 1.1})
        assert "object_range_m was " in text
        assert "object_turn_rad was " in text


def test_paths_about_other_centres_leave_the_range(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    checkpoint.save(tmp_path / "x", *parts(SINE, "shared", random_path=True))
    moved = ((0.0, 0.62, 0.4), (0.0, -0.6, 0.4))
    with caplog.at_level(logging.WARNING):
        policies.load(tmp_path / "x", SINE, center_m=moved)
        assert not caplog.records
        policies.load(tmp_path / "x", SINE, center_m=moved, random_path=True)
    assert "center_m was" in caplog.records[0].message


def test_an_arm_that_never_gave_leaves_the_range(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    checkpoint.save(tmp_path / "x", *parts(HANDOVER, "shared"))
    with caplog.at_level(logging.WARNING):
        policies.load(tmp_path / "x", HANDOVER, giver="right")
    assert "giver was 'left' and is 'right'" in caplog.records[0].message


def test_differences_without_effect_are_warnings(saved: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        policies.load(saved, SINE, action_latency_ticks=5, amplitude_m=0.08, randomization="mild")
        assert not caplog.records
        for _ in range(2):
            policies.load(saved, SINE, action_latency_ticks=5)
    (record,) = caplog.records  # once
    assert record.message.endswith("may perform worse: amplitude_m was 0.08 and is 0.1")
    caplog.clear()
    policies.load(saved, SINE, action_latency_ticks=5, amplitude_m=0.08, randomization={"mass": 0.04, "skew_s": 0.001})
    assert caplog.records[-1].message.endswith("worse: randomization mass was 0 and is 0.04")
    policies.load(saved, SINE, action_latency_ticks=5, amplitude_m=0.08, randomization="wide")
    assert "latency_s was 0 and is 0.016" in caplog.records[-1].message
    assert "object" not in caplog.records[-1].message
    caplog.clear()
    mount = dual_ur10.CellConfig().left
    off = dataclasses.replace(mount.dh, theta_rad=(1e-3, 0.0, 0.0, 0.0, 0.0, 0.0))
    policies.load(
        saved,
        SINE,
        action_latency_ticks=5,
        amplitude_m=0.08,
        cell=dual_ur10.CellConfig(left=dataclasses.replace(mount, dh=off)),
    )
    assert "calibrated" in caplog.text


def test_moved_bases_and_other_tools_are_warnings(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    checkpoint.save(tmp_path / "x", *parts(HANDOVER, "shared"))
    nominal = dual_ur10.CellConfig()

    def warnings(**changes: Any) -> list[str]:
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            policies.load(tmp_path / "x", HANDOVER, cell=dual_ur10.CellConfig(**changes))
        return [record.message.rpartition("perform worse: ")[2] for record in caplog.records]

    def left(by_m: float = 0.0, yaw_rad: float = 0.0) -> dict[str, Any]:
        x, y, z = nominal.left.position_m
        moved = dataclasses.replace(nominal.left, position_m=(x + by_m, y, z), yaw_rad=nominal.left.yaw_rad + yaw_rad)
        return {"left": moved}

    assert warnings(**left(0.0005, 0.0004)) == []  # as in "mild"
    assert warnings(**left(0.02)) == ["a base is 20.0 mm and 0.00 degrees from its place in training"]
    assert warnings(**left(0.0, 0.01)) == ["a base is 0.0 mm and 0.57 degrees from its place in training"]
    wider = ("robotiq_2f85", "generic_140")
    checkpoint.save(tmp_path / "y", *parts(HANDOVER, "shared", cell=dual_ur10.CellConfig(tools=wider, **left(0.02))))
    assert checkpoint.load(tmp_path / "y").manifest.signature.robot.tools == wider
    with pytest.raises(CheckpointError, match="made for observation"):
        policies.load(tmp_path / "y", HANDOVER)


def test_a_checkpoint_of_another_family_loads_without_keywords(tmp_path: Path) -> None:
    profile = dual_ur10.ServojProfile("e-series", gain=1800.0)
    networks, made = parts(HANDOVER, "shared", cell=dual_ur10.CellConfig(servoj=profile), action_latency_ticks=20)
    checkpoint.save(tmp_path / "x", networks, made)
    assert checkpoint.load(tmp_path / "x").manifest.signature.robot.gain == 1800.0
