"""Configuration of a cell: refusals and equality."""

from __future__ import annotations

import dataclasses
import os
import pickle
from pathlib import Path
from typing import Any

import pytest

from dual_ur10.assets.collision_model import clearance_pairs
from dual_ur10.assets.obstacles import Box
from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.errors import CellFileError, RateError, SettingsError, UnknownNameError
from dual_ur10.sim2real.cell.cell_config import LATENCY_S, CellConfig
from dual_ur10.sim2real.cell.named_cell import resolve_cell
from dual_ur10.sim2real.cell.perturbation import TYPICAL_PERTURBATION
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics.frames import ArmMount
from ur_core.servoj import ServojProfile

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("family", "timestep_s", "substeps"),
    [("cb3", 0.002, 4), ("cb3", 0.001, 8), ("cb3", 0.008, 1), ("e-series", 0.002, 1), ("e-series", 0.0005, 4)],
)
def test_the_timestep_divides_the_tick(family: str, timestep_s: float, substeps: int) -> None:
    assert CellConfig(servoj=ServojProfile(family=family), timestep_s=timestep_s).substeps == substeps


@pytest.mark.parametrize(
    ("family", "timestep_s"), [("cb3", 0.003), ("cb3", 0.005), ("cb3", 0.016), ("e-series", 0.004)]
)
def test_a_timestep_beside_the_tick_is_refused_with_examples(family: str, timestep_s: float) -> None:
    with pytest.raises(RateError, match="divide") as caught:
        CellConfig(servoj=ServojProfile(family=family), timestep_s=timestep_s)
    assert ("0.004, 0.002, 0.001" if family == "cb3" else "0.001, 0.0005") in str(caught.value)


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="cell kind"):
        CellConfig(kind="gazebo")  # type: ignore[arg-type]


@pytest.mark.parametrize("make", [CellConfig, lambda: CellConfig(perturbation=TYPICAL_PERTURBATION)])
def test_equal_configurations_are_equal_and_hash_alike(make) -> None:
    assert make() == make()
    assert hash(make()) == hash(make())
    assert pickle.loads(pickle.dumps(make())) == make()
    assert make() != CellConfig(left=ArmMount((-0.9, 0.6, 0.0)))


def test_with_perturbation_changes_only_what_is_named() -> None:
    config = CellConfig(perturbation=TYPICAL_PERTURBATION, timestep_s=0.001).with_perturbation(loss=0.1)
    assert config.perturbation.loss == 0.1
    assert config.perturbation.mass_scale == 1.05
    assert config.timestep_s == 0.001


def test_resolve_cell() -> None:
    config = CellConfig(timestep_s=0.001)
    assert resolve_cell(config) is config
    assert resolve_cell("mujoco") == CellConfig()
    for unknown in ("gazebo", None, 3, {"kind": "mujoco"}):
        with pytest.raises(UnknownNameError, match="mujoco"):
            resolve_cell(unknown)


def test_servoj_settings_with_which_arms_swing_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"swings.*0\.15.*gain of 400"):
        CellConfig(servoj=ServojProfile(lookahead_s=0.03, gain=100))
    CellConfig(servoj=ServojProfile(lookahead_s=0.03, gain=401))
    assert ServojProfile(lookahead_s=0.1, gain=400).damping == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"servoj": "cb3"}, "ServojProfile"),
        ({"perturbation": {"mass_scale": 1.1}}, "Perturbation"),
        ({"speed_rad_s": "fast"}, "must be a number"),
        ({"speed_rad_s": True}, "must be a number"),
        ({"speed_rad_s": 1e-9}, "0.01 or more"),
        ({"tcp_speed_m_s": NAN}, "0.01 or more"),
        ({"acceleration_rad_s2": 0.001}, "acceleration_rad_s2.*0.01 or more"),
        ({"jerk_rad_s3": "much"}, "jerk_rad_s3.*must be a number"),
        ({"speed_factor": 0.0}, "speed_factor.*above 0 and at most 1"),
        ({"speed_factor": -0.5}, "speed_factor.*above 0 and at most 1"),
        ({"speed_factor": 1.01}, "speed_factor.*above 0 and at most 1"),
        ({"speed_factor": NAN}, "speed_factor.*above 0 and at most 1"),
        ({"speed_factor": True}, "must be a number"),
        ({"minimum_clearance_m": "a"}, "must be a number"),
        *(({"minimum_clearance_m": each}, "minimum_clearance_m") for each in (0.0049, 0.0, -0.02, NAN, INF, 0.2, 0.3)),
        *(({"timestep_s": each}, "timestep") for each in (0.0, -0.002, NAN, INF)),
        ({"wrench_noise": 5.0}, "two numbers"),
        ({"wrench_noise": ("a", "b")}, "must be a number"),
        ({"wrench_noise": (1000.0, 1.0)}, "0 to 100"),
    ],
)
def test_values_that_are_not_legal_are_refused_by_name(values: dict[str, Any], text: str) -> None:
    with pytest.raises(SettingsError, match=text):
        CellConfig(**values)


# ------------------------------------------------------------------------------------------------ two controllers

FILE = """kind = "emulated"
speed_factor = 0.5
[left]
host = "127.0.0.2"
family = "{family}"
[left.limits]
speed_rad_s = 0.4
tcp_speed_m_s = 0.3
acceleration_rad_s2 = 2.0
jerk_rad_s3 = 50.0
[right]
host = "127.0.0.3"
family = "{family}"
[[obstacle]]
kind = "box"
name = "feeder"
position_m = [0.6, 0.0, 0.3]
size_m = [0.2, 0.2, 0.2]
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    result = tmp_path / "lab.toml"
    result.write_text(FILE.format(family="cb3"))
    return result


def test_a_cell_of_controllers_comes_from_its_file(path: Path) -> None:
    config = resolve_cell(path)
    assert (config.kind, config.speed_factor) == ("emulated", 0.5)
    assert config.file is not None
    assert config == config.file.config() == resolve_cell(str(path)) == resolve_cell(os.fspath(path))
    assert hash(config) == hash(resolve_cell(path))
    assert pickle.loads(pickle.dumps(config)) == config
    assert config != CellConfig()


def test_a_path_is_distinguished_from_a_name(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(path.parent)
    assert resolve_cell("lab.toml") == resolve_cell("./lab.toml") == resolve_cell(Path("lab.toml"))
    (path.parent / "mujoco").write_text("kind = 3")
    assert resolve_cell("mujoco") == CellConfig()
    for missing in ("none.toml", "a/b", Path("mujoco"), Path("nowhere")):
        with pytest.raises(CellFileError):
            resolve_cell(missing)
    with pytest.raises(UnknownNameError, match=r"such as lab\.toml"):
        resolve_cell("lab")


@pytest.mark.parametrize("kind", ["emulated", "real"])
def test_a_kind_without_its_file_is_refused(kind: Any, path: Path) -> None:
    with pytest.raises(SettingsError, match="needs a cell file"):
        CellConfig(kind=kind)
    with pytest.raises(SettingsError, match="kind 'mujoco' has no cell file"):
        dataclasses.replace(resolve_cell(path), kind="mujoco")


@pytest.mark.parametrize(("family", "ticks"), [("cb3", 5), ("e-series", 20)])
def test_the_default_latency(path: Path, family: str, ticks: int) -> None:
    path.write_text(FILE.format(family=family))
    config = resolve_cell(path)
    assert config.latency_ticks == ticks
    assert config.latency_ticks * config.servoj.tick_s == pytest.approx(LATENCY_S)
    assert CellConfig(servoj=ServojProfile(family=family)).latency_ticks == 0


def test_caps_hold_in_real_time(path: Path) -> None:
    config = resolve_cell(path)
    task = MotionLimits(speed_rad_s=(1.6, 1.6, 2.0, 2.0, 2.0, 0.5), tcp_speed_m_s=1.2)
    found = config.capped(task)
    slow = config.speed_factor
    assert found.speed_rad_s == (0.8, 0.8, 0.8, 0.8, 0.8, 0.5)
    assert found.tcp_speed_m_s * slow == 0.3
    assert found.acceleration_rad_s2 * slow**2 == 2.0
    assert found.jerk_rad_s3 * slow**3 == 50.0
    assert (found.lower_rad, found.upper_rad) == (task.lower_rad, task.upper_rad)
    # Tighter limits of the task stay.
    gentle = MotionLimits(speed_rad_s=0.1, tcp_speed_m_s=0.1, acceleration_rad_s2=1.0, jerk_rad_s3=20.0)
    assert config.capped(gentle) == gentle
    assert CellConfig().capped(task) == task
    assert CellConfig(speed_factor=0.25).capped(task) == task


def test_obstacles_are_part_of_the_collision_model(path: Path) -> None:
    config = resolve_cell(path)
    (box,) = config.obstacles
    assert config.scene.obstacles == (box,)
    assert len(clearance_pairs(config.scene)) > len(clearance_pairs(CellConfig().scene))
    near = Box(name="near", position_m=(-0.75, 0.6, 1.0), size_m=(0.5, 0.5, 0.5))
    q = HOME_Q_RAD.reshape(1, 12)
    assert Clearance(CellConfig().scene).is_clear(q).all()
    assert not Clearance(dataclasses.replace(config, obstacles=(near,)).scene).is_clear(q).any()
