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
    with pytest.raises(SettingsError, match="scripted policies read all fields"):
        policies.load("scripted", HANDOVER, observation="goals")
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


def test_a_checkpoint_of_another_family_loads_without_keywords(tmp_path: Path) -> None:
    profile = dual_ur10.ServojProfile("e-series", gain=1800.0)
    networks, made = parts(HANDOVER, "shared", cell=dual_ur10.CellConfig(servoj=profile), action_latency_ticks=20)
    checkpoint.save(tmp_path / "x", networks, made)
    assert checkpoint.load(tmp_path / "x").manifest.signature.robot.gain == 1800.0
