"""Cell files: reading, writing, refusals, configuration, template and reference page."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import os
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from dual_ur10 import ENV_IDS
from dual_ur10.assets.obstacles import Box, Capsule, Plane
from dual_ur10.assets.props import BLOCK
from dual_ur10.assets.settings import Equipment, SceneSettings
from dual_ur10.emulated.cell_emulator import CellEmulator, CellOptions, write_cell_file
from dual_ur10.envs.api.dual_arm_env import DualArmEnv
from dual_ur10.errors import CellFileError, DualUR10Error, SettingsError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.perturbation import Perturbation
from dual_ur10.sim2real.cell_file import cell_file as module
from dual_ur10.sim2real.cell_file.cell_file import CellFile, examine_text, keys, load_cell_file
from dual_ur10.sim2real.cell_file.reference import EXAMPLES, reference_page, starting_text, write_new
from dual_ur10.sim2real.cell_file.tables import (
    ArmEntry,
    ArmLimits,
    AttachedTrackerEntry,
    DigitalGripper,
    EmulatedTrackerEntry,
    EmulatorEntry,
    GivenTrackerEntry,
    Measured,
    NoGripper,
    OwnTrackerEntry,
    RobotiqSocket,
    keywords_of,
)
from dual_ur10.sim2real.cell_file.text import Key, toml_text
from dual_ur10.sim2real.control.limits import MotionLimits
from tests.soak import scaled
from ur_core.kinematics import ur10
from ur_core.kinematics.robots import ROBOTS
from ur_core.mjcf.camera import Camera
from ur_core.mjcf.gains import STIFF, Gains
from ur_core.servoj import ServojProfile
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85

VALVE = dataclasses.replace(ROBOTIQ_2F85, name="valve", drivers=("digital_output",))

ROOT = Path(__file__).parents[3]
DELETE = object()

ARM: dict[str, Any] = {
    "family": "cb3",
    "base_yaw_rad": 0.5,
    "base_uncertainty_m": 0.002,
    "tcp_position_m": [0.0, 0.0, 0.17],
    "tcp_rotation_rad": [0.0, 0.0, 1.0],
    "payload_kg": 1.2,
    "payload_cog_m": [0.0, 0.01, 0.05],
}
GOOD: dict[str, Any] = {
    "kind": "real",
    "name": "lab-1",
    "speed_factor": 0.25,
    "left": {**ARM, "host": "192.168.1.10", "base_position_m": [-0.75, 0.6, 0.0]},
    "right": {**ARM, "host": "192.168.1.11", "base_position_m": [-0.75, -0.6, 0]},
}
SMALL: dict[str, Any] = {"kind": "emulated", "left": {"host": "127.0.0.2"}, "right": {"host": "127.0.0.3"}}


def edited(base: dict[str, Any], **edits: Any) -> dict[str, Any]:
    """With values at paths such as `left__servoj__gain`."""
    result = copy.deepcopy(base)
    for path, value in edits.items():
        *tables, name = path.split("__")
        place = result
        for table in tables:
            place = place.setdefault(table, {})
        if value is DELETE:
            del place[name]
        else:
            place[name] = value
    return result


def cell_of(base: dict[str, Any], **edits: Any) -> CellFile:
    """Return the cell of a text with edits at paths such as `left__servoj__gain`."""
    return CellFile.read(tomllib.loads(toml_text(edited(base, **edits))), "lab.toml")


def loaded(tmp_path: Path, content: dict[str, Any] | str | bytes) -> CellFile:
    path = tmp_path / "lab.toml"
    text = toml_text(content) if isinstance(content, dict) else content
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_cell_file(path)


def refused(tmp_path: Path, content: dict[str, Any] | str | bytes) -> str:
    with pytest.raises(CellFileError) as caught:
        loaded(tmp_path, content)
    text = str(caught.value)
    assert "lab.toml" in text
    assert "\n" not in text
    assert len(text) < 1000 + len(str(tmp_path)) * 3
    return text


# Content of a file.


def test_gains_are_those_of_the_file_or_of_the_task() -> None:
    table = {"kp_nm_rad": [900.0] * 6, "kv_nms_rad": [60.0, 60.0, 60.0, 50.0, 40.0, 30.0]}
    for values, wanted in (({}, STIFF), ({"gains": table}, Gains(*table.values()))):
        cell = cell_of({**GOOD, **values})
        for config in (cell.config(), cell.simulated(), CellFile.read(tomllib.loads(cell.text())).config()):
            assert config.equipped(Equipment(), 0.002, STIFF).scene.gains == wanted


def test_each_arm_has_the_tool_that_the_file_names() -> None:
    generic = {"kind": "digital_output", "output": 0, "tool": "generic_140"}
    for left, right, names in (
        ({"kind": "robotiq"}, generic, ["robotiq_2f85", "generic_140"]),
        ({"kind": "none"}, generic, ["generic_140"] * 2),
        ({"kind": "own", "driver": "a:B", "tool": f"{__name__}:VALVE"}, generic, ["valve", "generic_140"]),
        ({"kind": "none"}, {"kind": "none"}, ["robotiq_2f85"] * 2),
    ):
        config = cell_of(GOOD, left__gripper=left, right__gripper=right).config()
        for scene in (config.scene, config.measured_scene):
            assert [tool.name for tool in scene.equipment.tools] == names
        assert config.measured_scene.equipment.grippers == (right["kind"] != "none")
        equipment = config.equipped(Equipment(grippers=True, props=(BLOCK,)), 0.002, STIFF).equipment
        assert [tool.name for tool in equipment.tools] == names


def test_every_key_is_read() -> None:
    cell = cell_of(
        GOOD,
        task="DualUR10/SyncCarry-v0",
        rt_priority=80,
        left__serial_number="2010300001",
        left__base_tilt_rad=[0.004, -0.002],
        left__safety_checksum=0x57F4285B,
        left__gripper={"kind": "robotiq", "port": 1234},
        right__gripper={"kind": "digital_output", "output": 16, "open_level": True, "tool": f"{__name__}:VALVE"},
        left__servoj={"lookahead_s": 0.05, "gain": 500},
        left__limits={"speed_rad_s": 1, "jerk_rad_s3": 150.0},
        left__measured={"lookahead_s": 0.031, "latency_s": 0},
        left__calibration={"theta_rad": [1e-4, 0, 0, 0, 0, 0], "checksum": [1, 2, 3, 4, 5, 4294967295]},
        tracker=[
            {"prop": "bar", "kind": "given", "position_m": [0, 0, 0.1], "rotation_rad": [0, 0, 1.5]},
            {"prop": "lid", "kind": "own", "tracker": "my_lab.camera:Camera", "options": "serial=a17 rate=30"},
        ],
        camera=[
            {"name": "front", "kind": "v4l2", "device": "/dev/video2", "format": "yuyv422", "delay_s": 0.02},
            {
                "name": "left/wrist",
                "kind": "pattern",
                "rate_hz": 60,
                "body": "left/gripper",
                "fovy_rad": 1.2,
                "position_m": [0.1, 0, 0],
                "target_m": [0, 0, 0.2],
                "up": [1, 0, 0],
            },
        ],
        obstacle=[
            {"name": "wall", "kind": "plane", "point_m": [1, 0, 0], "normal": [-1, 0, 0]},
            {"name": "box", "kind": "box", "position_m": [0, 1.5, 0.2], "size_m": [0.1, 0.2, 0.3]},
            {"name": "post", "kind": "capsule", "from_m": [1, 1, 0], "to_m": [1, 1, 2], "radius_m": 0.1},
        ],
    )
    left = cell.left
    assert (cell.kind, cell.name, cell.task, cell.speed_factor, cell.rt_priority) == (
        "real",
        "lab-1",
        "DualUR10/SyncCarry-v0",
        0.25,
        80,
    )
    assert (left.host, left.family, left.serial_number) == ("192.168.1.10", "cb3", "2010300001")
    assert left.profile == ServojProfile("cb3", 0.05, 500.0)
    assert left.mount.position_m == (-0.75, 0.6, 0.0)
    assert left.mount.yaw_rad == 0.5
    assert left.mount.tilt_rad == (0.004, -0.002)
    assert cell.right.mount.tilt_rad == (0.0, 0.0)
    assert left.mount.dh.theta_rad[0] == 1e-4
    assert left.mount.dh.a_m == tuple(ur10.DH_A_M)
    assert left.calibration.checksum == (1, 2, 3, 4, 5, 4294967295)
    assert left.safety_checksum == 0x57F4285B
    assert (left.base_uncertainty_m, left.base_uncertainty_rad) == (0.002, 0.0)
    assert left.tcp == (0.0, 0.0, 0.17, 0.0, 0.0, 1.0)
    assert (left.payload_kg, left.payload_cog_m) == (1.2, (0.0, 0.01, 0.05))
    assert left.limits == ArmLimits(speed_rad_s=1.0, jerk_rad_s3=150.0)
    assert left.measured == Measured(lookahead_s=0.031, latency_s=0.0)
    assert cell.right.measured == Measured()
    assert left.gripper == RobotiqSocket(port=1234)
    assert cell.right.gripper == DigitalGripper(output=16, open_level=True, tool=f"{__name__}:VALVE")
    assert cell.tracker == (
        GivenTrackerEntry(prop="bar", position_m=(0.0, 0.0, 0.1), rotation_rad=(0.0, 0.0, 1.5)),
        OwnTrackerEntry(prop="lid", tracker="my_lab.camera:Camera", options="serial=a17 rate=30"),
    )
    assert keywords_of(cell.tracker[1].options) == {"serial": "a17", "rate": 30}
    front, wrist = cell.camera
    assert (front.device, front.format, front.width, front.height) == ("/dev/video2", "yuyv422", 640, 480)
    assert front.mounted is None
    assert cell_of(GOOD, camera=[each.mapping() for each in cell.camera]).config().cameras == (
        ("left/wrist", wrist.mounted),
    )
    assert wrist.mounted == Camera("wrist", (0.1, 0, 0), (0, 0, 0.2), math.degrees(1.2), "left/gripper", (1, 0, 0))
    assert cell.obstacles == (
        Plane(name="wall", point_m=(1.0, 0.0, 0.0), normal=(-1.0, 0.0, 0.0)),
        Box(name="box", position_m=(0.0, 1.5, 0.2), size_m=(0.1, 0.2, 0.3)),
        Capsule(name="post", from_m=(1.0, 1.0, 0.0), to_m=(1.0, 1.0, 2.0), radius_m=0.1),
    )
    assert cell.emulator is None
    assert cell.source.endswith("lab.toml")


def test_defaults_of_an_emulated_cell() -> None:
    cell = cell_of(SMALL)
    assert [each.mount for each in cell.arms] == list(SceneSettings().mounts)
    assert dataclasses.replace(cell.config(), kind="mujoco", file=None) == CellConfig()
    assert (cell.speed_factor, cell.rt_priority, cell.name, cell.task) == (1.0, 0, "cell", None)
    assert cell.left.gripper == NoGripper()
    assert (
        cell.left.tcp
        is cell.left.payload_kg
        is cell.left.serial_number
        is cell.left.calibration.checksum
        is cell.left.safety_checksum
        is None
    )
    assert cell.emulator is None
    assert cell.tracker == ()
    assert cell.obstacles == ()
    assert cell_of(SMALL, left__gripper={"kind": "robotiq"}).left.gripper == RobotiqSocket(port=63352)
    only = cell_of(SMALL, left__tcp_position_m=[0, 0, 0.1])
    assert only.left.tcp == (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("kind", ["attached", "emulated"])
def test_trackers_by_kind(kind: str) -> None:
    emulator = {"port": 4000, "task": ENV_IDS[0], "pid": 17}
    cell = cell_of(SMALL, tracker=[{"prop": "block", "kind": kind}], emulator=emulator)
    kinds = {"attached": AttachedTrackerEntry, "emulated": EmulatedTrackerEntry}
    assert cell.tracker == (kinds[kind](prop="block"),)
    assert cell.emulator == EmulatorEntry(port=4000, task=ENV_IDS[0], pid=17)


def test_the_emulators_file_loads(tmp_path: Path) -> None:
    for task in ("SineTracking", "Handover"):
        path = tmp_path / f"{task}.toml"
        emulator = CellEmulator(CellOptions(task=task, family="e-series", cell=str(path)))
        try:
            cell = load_cell_file(path)
            assert [each.host for each in cell.arms] == [each.host for each in emulator.servers]
            assert cell.emulator == EmulatorEntry(**emulator.description()["emulator"])
            config = emulator.world.config
            assert (cell.config().left, cell.config().servoj) == (config.left, config.servoj)
            assert isinstance(cell.right.gripper, RobotiqSocket) == (task == "Handover")
        finally:
            emulator.close()
    write_cell_file(path, cell.mapping())  # and one place knows how it is written
    assert path.read_text() == cell.text()


# Written and read again.


def one(key: Key) -> st.SearchStrategy[Any]:
    schema = key.single
    if choices := schema.get("enum"):
        return st.sampled_from(choices)
    if key.name == "task":
        return st.sampled_from(ENV_IDS)
    if key.name == "settings":
        return st.dictionaries(st.text(max_size=5), st.lists(st.floats(-1, 1), max_size=3)).map(json.dumps)
    if schema["type"] == "string":
        return st.from_regex(schema["pattern"].removesuffix("$") + r"\Z")
    if schema["type"] == "boolean":
        return st.booleans()
    if schema["type"] == "integer":
        return st.integers(schema["minimum"], schema["maximum"])
    return st.floats(schema["minimum"], schema["maximum"])


def table_of(
    path: str, real: bool, variant: str = "", **fixed: st.SearchStrategy[Any]
) -> st.SearchStrategy[dict[str, Any]]:
    """Tables of the keys directly below a path."""
    must, may = {}, {}
    for key in keys().keys:
        if key.path != f"{path}{key.name}" or key.name == "kind" != path + key.name or key.variant not in ("", variant):
            continue
        each = fixed.get(key.name)
        if each is None:
            each = one(key) if not key.count else st.lists(one(key), min_size=key.count, max_size=key.count)
        required = key.required or (real and key.schema.get("if_real"))
        (must if required else may)[key.name] = each
    return st.fixed_dictionaries(must, optional=may)


@st.composite
def variant_of(draw: st.DrawFn, path: str, real: bool, **fixed: st.SearchStrategy[Any]) -> dict[str, Any]:
    (choices,) = (key.single["enum"] for key in keys().keys if key.path == f"{path}kind")
    kind = draw(st.sampled_from([each for each in choices if not (real and each == "emulated")]))
    if kind == "plane":
        normal = draw(st.sampled_from([(1, 0, 0), (0, -1.0, 0), (0, 0.6, 0.8)]))
        fixed |= {"normal": st.just(list(normal)), "point_m": st.just([-6.0 * each for each in normal])}
    return {"kind": kind, **draw(table_of(path, real, kind, **fixed))}


@st.composite
def arm_tables(draw: st.DrawFn, real: bool, side: float, host: str) -> dict[str, Any]:
    near = st.floats(-0.01, 0.01)
    position = st.tuples(st.floats(-3, 3), st.floats(0.2, 3).map(lambda y: side * y), st.floats(0, 3)).map(list)
    values = draw(table_of("ARM.", real, host=st.just(host), base_position_m=position, model=st.just("ur10")))
    family = values.get("family", "cb3")
    values["model"] = draw(st.sampled_from([name for name, each in ROBOTS.items() if each.family == family]))
    if "payload_kg" in values:
        values["payload_kg"] = min(values["payload_kg"], ROBOTS[values["model"]].payload_kg)
    if draw(st.booleans()):
        values["gripper"] = draw(variant_of("ARM.gripper.", real, tool=st.just("robotiq_2f85")))
    for name in ("limits", "measured"):
        if draw(st.booleans()):
            values[name] = draw(table_of(f"ARM.{name}.", real))
    if "speed_rad_s" in (limits := values.get("limits", {})):
        slowest = float(ROBOTS[values["model"]].hard_speed_rad_s.min())
        limits["speed_rad_s"] = min(limits["speed_rad_s"], slowest)
    if draw(st.booleans()):
        lookahead = draw(st.floats(0.03, 0.2))
        gain = draw(st.floats(min(2000.0, max(100.0, 1.001 * (0.6 / lookahead) ** 2)), 2000.0))
        values["servoj"] = {"lookahead_s": lookahead, "gain": gain}
    if draw(st.booleans()):
        d = [each + draw(near) for each in ROBOTS[values["model"]].d_m]
        values["calibration"] = {
            "d_m": d,
            "checksum": draw(st.lists(st.integers(0, 2**32 - 1), min_size=6, max_size=6)),
        }
    return values


@st.composite
def contents(draw: st.DrawFn) -> dict[str, Any]:
    real = draw(st.booleans())
    values = draw(table_of("", real, kind=st.just("real" if real else "emulated")))
    hosts = ("10.1.2.3", "192.168.0.7") if real else ("127.0.0.1", "127.9.8.7")
    for name, side, host in zip(ur10.ARMS, (1.0, -1.0), hosts, strict=True):
        values[name] = draw(arm_tables(real, side, host))
    if not real:
        values["emulator"] = draw(table_of("emulator.", real))
    if draw(st.booleans()):
        values["tracker"] = [draw(variant_of("tracker.", real))]
    count = draw(st.integers(0, 3))
    if count:
        values["obstacle"] = [draw(variant_of("obstacle.", real, name=st.just(f"o_{row}"))) for row in range(count)]
    return values


def holds(found: Any, given_: Any) -> bool:
    """Return true if all that was given is part of what was found."""
    if isinstance(given_, dict):
        return all(holds(found.get(name, {}), each) for name, each in given_.items())
    if isinstance(given_, list):
        return len(found) == len(given_) and all(map(holds, found, given_))
    return bool(found == given_)


@settings(max_examples=scaled(2000, 40), suppress_health_check=list(HealthCheck))
@given(contents())
def test_what_is_written_is_read_again(content: dict[str, Any]) -> None:
    cell, findings = examine_text(toml_text(content))
    assert findings == []
    assert cell is not None
    again, findings = examine_text(cell.text())
    assert findings == []
    assert again == cell
    assert again.text() == cell.text()
    assert again.sha256 == cell.sha256
    assert holds(tomllib.loads(cell.text()), content)


def test_the_hash_covers_the_content_of_a_file(tmp_path: Path) -> None:
    plain = cell_of(GOOD)
    again = loaded(tmp_path, "# a comment\r\n" + toml_text(GOOD).replace("\n", "\r\n").replace("= 0.5", "= 5e-1"))
    assert (again, again.sha256) == (plain, plain.sha256)
    assert examine_text(toml_text(GOOD), "elsewhere").cell == plain
    assert cell_of(GOOD, left__base_yaw_rad=-0.0) == cell_of(GOOD, left__base_yaw_rad=0)
    zeros = [cell_of(GOOD, left__base_yaw_rad=each).sha256 for each in (-0.0, 0.0, 0)]
    assert len(set(zeros)) == 1
    assert cell_of(GOOD, left__payload_kg=1.3).sha256 != plain.sha256
    # Records name cell files by this hash: it may not change.
    small = "ba0e49b31f9cb380c3ec336c557855e4908a85b3c57c5f1144fd52b9c0dc6cd7"
    assert cell_of(SMALL).sha256 == small


def test_odd_texts_are_valid_toml() -> None:
    odd = {"a": 'q"\\\n\x7f\x00é😀', "b": [1e-7, 1e22, True], "c": [], "t": {"u": {"v": 1}}, "w": [{"x": 1}, {"x": 2}]}
    assert tomllib.loads(toml_text(odd)) == odd
    assert tomllib.loads(toml_text({"a": 1, "empty": {}})) == {"a": 1, "empty": {}}


def test_changed_cells_are_checked_too() -> None:
    cell = cell_of(GOOD)
    assert cell.replace(speed_factor=0.5).speed_factor == 0.5
    with pytest.raises(CellFileError, match=r"lab\.toml: speed_factor is 2"):
        cell.replace(speed_factor=2.0)
    with pytest.raises(CellFileError, match=r"right\.host is 192\.168\.1\.10, as left\.host is"):
        cell.replace(right=cell.right.replace(host="192.168.1.10"))
    left, right = ArmEntry(host="127.0.0.2"), ArmEntry(host="127.0.0.3")
    assert CellFile(kind="emulated", left=left, right=right) == cell_of(SMALL)
    for wrong in ({"kind": "real"}, {"right": left}):
        with pytest.raises(ValidationError):
            CellFile(**{"kind": "emulated", "left": left, "right": right, **wrong})


# Refusals.

PLACED = {"name": "x", "kind": "pattern", "position_m": [1, 0, 0]}
BOX = {"name": "b", "kind": "box", "position_m": [0, 1.5, 0], "size_m": [1, 1, 1]}
PLANE = {"name": "p", "kind": "plane", "point_m": [1, 0, 0], "normal": [-1, 0, 0]}
REFUSED: list[tuple[dict[str, Any], tuple[str, ...]]] = [
    # Types.
    ({"speed_factor": True}, ("speed_factor is true", "a number, 0.05 to 1", "speed_factor = 0.25")),
    ({"speed_factor": "0.5"}, ('speed_factor is "0.5"', "a number")),
    ({"rt_priority": 1.0}, ("rt_priority is 1.0", "a whole number, 0 to 90")),
    ({"rt_priority": False}, ("rt_priority is false",)),
    ({"name": 3}, ("name is 3", "letters")),
    ({"left": 3}, ("left is 3", "a table", "[left]")),
    ({"left__servoj": [1]}, ("left.servoj is [1]", "[left.servoj]")),
    ({"left__tcp_position_m": 0.1}, ("left.tcp_position_m is 0.1", "3 numbers, -1 to 1", "in brackets")),
    ({"left__tcp_position_m": [0, 0]}, ("left.tcp_position_m is [0, 0]", "3 of them")),
    ({"left__tcp_position_m": [0, 0, True]}, ("left.tcp_position_m[2] is true",)),
    ({"left__serial_number": 2010300001}, ("left.serial_number is 2010300001", "in quotes")),
    ({"left__calibration__checksum": [1, 2, 3, 4, 5, 1.5]}, ("left.calibration.checksum[5] is 1.5",)),
    (
        {"right__gripper": {"kind": "digital_output", "output": 1, "open_level": 1}},
        ("open_level is 1", "true or false"),
    ),
    ({"obstacle": BOX}, ("obstacle is a table", "[[obstacle]]")),
    ({"obstacle": [1]}, ("obstacle[0] is 1", "a table")),
    ({"obstacle": [{**BOX, "name": f"b{i}"} for i in range(65)]}, ("obstacle is 65 tables", "at most 64")),
    # Ranges.
    ({"speed_factor": 0}, ("speed_factor is 0",)),
    ({"speed_factor": 1.0001}, ("speed_factor is 1.0001",)),
    ({"speed_factor": -0.1}, ("speed_factor is -0.1",)),
    ({"rt_priority": 91}, ("rt_priority is 91", "0 to 90")),
    ({"rt_priority": 10**400}, ("rt_priority is a very large number",)),
    ({"speed_factor": 10**400}, ("speed_factor is a very large number",)),
    ({"left__base_yaw_rad": 90}, ("left.base_yaw_rad is 90", "-6.28319 to 6.28319")),
    ({"left__base_tilt_rad": [2.0, 0.0]}, ("left.base_tilt_rad[0] is 2.0", "-0.0872665 to 0.0872665")),
    ({"left__base_tilt_rad": [0.01, 0.0, 0.0]}, ("left.base_tilt_rad", "2 numbers")),
    ({"left__base_position_m": [-750, 600, 0]}, ("left.base_position_m[0] is -750", "-3 to 3")),
    ({"left__base_uncertainty_m": -0.001}, ("left.base_uncertainty_m is -0.001",)),
    ({"left__payload_kg": 10.5}, ("left.payload_kg is 10.5", "0 to 10", "UR10")),
    ({"left__servoj__gain": 5000}, ("left.servoj.gain is 5000", "100 to 2000")),
    ({"left__servoj__lookahead_s": 0.3}, ("left.servoj.lookahead_s is 0.3", "0.03 to 0.2")),
    ({"left__gripper": {"kind": "robotiq", "port": 65536}}, ("left.gripper.port is 65536",)),
    ({"left__gripper": {"kind": "digital_output", "output": 18}}, ("left.gripper.output is 18", "0 to 17")),
    # Only tighter than the hard limits.
    ({"left__limits__speed_rad_s": 1.69}, ("left.limits.speed_rad_s is 1.69", "of a UR10 is 1.68 rad/s")),
    ({"left__limits__speed_rad_s": 3.0}, ("left.limits.speed_rad_s is 3", "0.01 to 2.51", "hard limit of the model's")),
    ({"left__limits__acceleration_rad_s2": 10.1}, ("left.limits.acceleration_rad_s2 is 10.1", "to 10", "hard limit")),
    ({"left__limits__jerk_rad_s3": 2001}, ("left.limits.jerk_rad_s3 is 2001", "to 2000", "hard limit")),
    ({"right__limits__tcp_speed_m_s": 1.6}, ("right.limits.tcp_speed_m_s is 1.6", "to 1.5", "hard limit")),
    ({"right__limits__tcp_speed_m_s": 0.0}, ("right.limits.tcp_speed_m_s is 0.0",)),
    # Texts.
    ({"kind": "reel"}, ('kind is "reel"', '"real" or "emulated"')),
    ({"left__family": "e"}, ('left.family is "e"', '"cb3" or "e-series"')),
    ({"name": "../etc"}, ('name is "../etc"',)),
    ({"name": "a\nstopj(2)"}, ('name is "a\\nstopj(2)"',)),
    ({"name": "a\n"}, ("name is",)),
    ({"name": "x" * 65}, ("name is", "...")),
    ({"left__serial_number": "20 1"}, ("left.serial_number is",)),
    ({"task": "SyncCarry"}, ('task is "SyncCarry"', "DualUR10/SineTracking-v0")),
    ({"left__host": "ur-left.lab"}, ('left.host is "ur-left.lab"', "names are not looked up")),
    ({"left__host": "192.168.1.010"}, ("left.host is",)),
    ({"left__host": "192.168.1.10:30004"}, ("left.host is",)),
    ({"left__host": "::1"}, ("left.host is",)),
    ({"left__host": "10.1"}, ("left.host is",)),
    ({"left__host": "１０.0.0.1"}, ("left.host is",)),
    # Keys.
    ({"left__servoj": {"gian": 500}}, ("left.servoj.gian is no key", "Did you mean gain?", "lookahead_s, gain")),
    ({"speedfactor": 0.2}, ("speedfactor is no key", "Did you mean speed_factor?")),
    ({"left__gain": 500}, ("left.gain is no key", "Did you mean ARM.servoj.gain?", "[left]")),
    ({"left__gripper": {"kind": "none", "port": 3}}, ("left.gripper.port is no key", 'kind = "robotiq" only')),
    ({"obstacle": [{**BOX, "radius_m": 1}]}, ("obstacle[0].radius_m is no key", 'kind = "capsule" only')),
    ({"obstacle": [{**PLANE, "include": "x"}]}, ("obstacle[0].include is no key",)),
    ({"left__gripper": {"kind": "robot"}}, ('left.gripper.kind is "robot"', '"robotiq"')),
    ({"left__gripper": {"kind": "digital_output"}}, ("left.gripper.output is missing", "output = 0")),
    (
        {"left__gripper": {"kind": "robotiq", "tool": f"{__name__}:VALVE"}},
        ("left.gripper.kind is 'robotiq'", "cannot drive the tool 'valve'", "use 'digital_output'"),
    ),
    ({"left__gripper": {"kind": "robotiq", "tool": "generic"}}, ("left.gripper.tool", "did you mean 'generic_140'")),
    ({"left__gripper": {"kind": "robotiq", "tool": "os:sep"}}, ("left.gripper.tool", "expected is a Tool")),
    ({"left__gripper": {"kind": "robotiq", "tool": "a b"}}, ('left.gripper.tool is "a b"', "or module:NAME")),
    ({"left__gripper": {"kind": "own", "driver": "a:B"}}, ("left.gripper.tool is missing",)),
    ({"left__gripper": {"kind": "own", "driver": "x.py", "tool": "generic_140"}}, ("left.gripper.driver is",)),
    ({"left__gripper": {"kind": ["none"]}}, ("left.gripper.kind is",)),
    ({"obstacle": [{"name": "b"}]}, ("obstacle[0].kind is missing", '"box" or "capsule" or "plane"')),
    ({"obstacle": [{"name": "b", "kind": "box", "size_m": [1, 1, 1]}]}, ("obstacle[0].position_m is missing",)),
    ({"tracker": [{"prop": "x", "kind": "given"}]}, ("tracker[0].position_m is missing",)),
    ({"kind": DELETE}, ("kind is missing", 'kind = "real"')),
    ({"right": DELETE}, ("right is missing", "two arms", "[right]")),
    ({"left__host": DELETE}, ("left.host is missing",)),
    # Keys that the file of a real cell has to name.
    *[
        ({f"left__{name}": DELETE}, (f"left.{name} is missing", "the file of a real cell"))
        for name in sorted({*ARM, "base_position_m"} - {"base_uncertainty_m"})
    ],
    ({"speed_factor": DELETE}, ("speed_factor is missing", "the file of a real cell")),
    # What does not fit together.
    ({"left__host": "127.0.0.1"}, ("left.host is 127.0.0.1", 'kind = "real"', "no robot")),
    ({"right__host": "127.4.5.6"}, ("right.host is 127.4.5.6", "no robot")),
    ({"right__host": "0.0.0.0"}, ("right.host is 0.0.0.0", "no single machine")),
    ({"right__host": "224.0.0.1"}, ("right.host is 224.0.0.1", "no single machine")),
    ({"right__host": "255.255.255.255"}, ("right.host is 255.255.255.255", "no single machine")),
    ({"kind": "emulated"}, ("left.host is 192.168.1.10", 'kind = "emulated"', "127.0.0.0/8")),
    ({"right__host": "192.168.1.10"}, ("right.host is 192.168.1.10, as left.host is", "of its own")),
    ({"left__servoj__gain": 100}, ("left.servoj.gain is 100", "damping 0.15", "0.3", "a gain of 400")),
    ({"left__base_position_m": [-0.75, -0.5, 0.0]}, ("left.base_position_m and right", "0.100 m apart", "0.3 m")),
    ({"left__base_position_m": [0, 0.6, -0.2]}, ("left.base_position_m", "inside the table")),
    ({"left__base_position_m": [-2, 0.6, -0.8]}, ("left.base_position_m", "floor")),
    (
        {"left__calibration": {"a_m": [0, -0.425, -0.39225, 0, 0, 0]}},
        ("left.calibration: DH parameter a_m[1] is -0.425", "another robot"),
    ),
    *(
        ({"kind": "emulated", "emulator": {"port": 4000, "settings": text}}, ("emulator.settings is", "a JSON object"))
        for text in ("", "[1]", "{'a': 1}", '{"a": NaN}', "[" * 3000, '{"a": "' + "b" * 4000 + '"}')
    ),
    ({"emulator": {"port": 4000}}, ("emulator is in the file of a real cell", 'kind = "emulated"')),
    ({"tracker": [{"prop": "x", "kind": "emulated"}]}, ('tracker[0].kind is "emulated"', "[emulator]")),
    ({"camera": [{"name": "x", "kind": "emulated"}]}, ('camera[0].kind is "emulated"', "[emulator]")),
    ({"camera": [{"name": "x", "kind": "pattern"}] * 2}, ("two cameras are named 'x'",)),
    ({"camera": [{"name": "x", "kind": "pattern", "position_m": [1, 0, 0]}]}, ("state both, or neither",)),
    ({"camera": [{**PLACED, "target_m": [1, 0, 0]}]}, ("camera[0]", "the points must differ")),
    ({"camera": [{**PLACED, "kind": "v4l2", "device": "/etc/x"}]}, ("camera[0].device is", "path of a device")),
    ({"obstacle": [BOX, PLANE, {**PLANE, "name": "b"}]}, ("obstacle[2].name is 'b', as that of obstacle[0]",)),
    ({"obstacle": [{**PLANE, "normal": [-1, -1, 0]}]}, ("obstacle[0].normal has the length 1.41421", "allowed is 1")),
    ({"obstacle": [{**PLANE, "normal": [0, 0, 0]}]}, ("obstacle[0].normal has the length 0",)),
    ({"obstacle": [{**PLANE, "normal": [1, 0, 0]}]}, ("obstacle[0].normal points away from the left base", "1.75 m")),
]


@pytest.mark.parametrize(("edits", "words"), REFUSED, ids=lambda each: "-".join(each)[:50] if each else "")
def test_illegal_values_are_refused(tmp_path: Path, edits: dict[str, Any], words: tuple[str, ...]) -> None:
    assert loaded(tmp_path, GOOD).kind == "real"
    text = refused(tmp_path, edited(GOOD, **edits))
    for word in words:
        assert word in text


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "+nan", "1e999", "1979-05-27", "07:32:00"])
@pytest.mark.parametrize("line", ["payload_kg = 1.2", "base_yaw_rad = 0.5", "speed_factor = 0.25"])
def test_numbers_have_to_be_finite(tmp_path: Path, line: str, value: str) -> None:
    name = line.split()[0]
    text = toml_text(GOOD).replace(line, f"{name} = {value}")
    assert f"{name} is " in refused(tmp_path, text)
    text = toml_text(GOOD).replace("[0.0, 0.0, 0.17]", f"[0.0, {value}, 0.17]")
    assert "left.tcp_position_m[1] is " in refused(tmp_path, text)


def test_an_emulated_tracker_needs_an_emulator(tmp_path: Path) -> None:
    assert "[emulator]" in refused(tmp_path, edited(SMALL, tracker=[{"prop": "block", "kind": "emulated"}]))
    twice = [{"prop": "block", "kind": "attached"}] * 2
    assert "two trackers are of the prop 'block'" in refused(tmp_path, edited(SMALL, tracker=twice))


def test_all_findings_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(toml_text(edited(GOOD, speed_factor=7, left__hots="x", right__payload_kg=-1)))
    cell, findings = module.examine(path)
    assert cell is None
    assert [each.split()[0] for each in findings] == ["speed_factor", "left.hots", "right.payload_kg"]
    odd = edited(GOOD, tracker=[{"kind": "radar", "arm": "left", "beam": 3}], obstacle=[{**BOX, "kind": 3, "hue": 1}])
    _, found = examine_text(toml_text(edited(odd, left__host=DELETE, left__tcp_position_m=DELETE)))
    assert [each.split()[0] for each in found] == [
        "tracker[0].kind",
        "tracker[0].beam",
        "obstacle[0].kind",
        "obstacle[0].hue",
        "left.host",
        "left.tcp_position_m",
    ]
    assert "Allowed in [obstacle[0]] are kind, name." in found[3]
    with pytest.raises(CellFileError, match=r"lab\.toml: speed_factor is 7.*\(2 more: .*cell check"):
        load_cell_file(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "kind is missing"),
        (b"kind = 'real'\nkind = 'real'\n", "no TOML"),
        (b"import os\n", "no TOML"),
        (b"\xff\xfe", "no text in UTF-8"),
        (b"\x00", "no TOML"),
        (b"a = " + b"[" * 60_000, "no TOML"),
        (b"a = " + b"9" * 60_000, "no TOML"),
        (b"a" + b".a" * 30_000 + b" = 1", "line 1 has 30000 dots"),
        (b"\n[" + b'"a". ' * 13_000 + b"a]", "line 2 has 13000 dots"),
        (b"# " + b"x" * 65_536, "longer than 65536 bytes"),
        (b"kind = " + b"[" * 150 + b"]" * 150, "kind is [[[[...]]]]"),
        (b'"\\u001b[31m\\n" = 1', "is no key"),
        (b'"\\u007f\\u202e\\U0001F600" = 1', "is no key"),
        (b'kind = "\\u007f\\u202e\\U0001F600"', "kind is"),
        (b'kind = "emulated"\nleft = {"' + b"k" * 60_000 + b'" = 1}', "..."),
    ],
    ids=lambda each: repr(each[:20]),
)
def test_hostile_files_are_refused(tmp_path: Path, content: bytes, words: str) -> None:
    text = refused(tmp_path, content)
    assert words in text
    assert text.isprintable()


def test_the_largest_file_is_read(tmp_path: Path) -> None:
    text = toml_text(GOOD)
    assert loaded(tmp_path, text + "#" * (65_536 - len(text))).kind == "real"
    refused(tmp_path, text + "#" * (65_537 - len(text)))


def test_paths_that_are_no_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CellFileError, match=r"no cell file .*none\.toml.*cell new"):
        load_cell_file(tmp_path / "none.toml")
    with pytest.raises(CellFileError, match="no regular file"):
        load_cell_file(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(CellFileError, match="no regular file"):
        load_cell_file(tmp_path / "pipe")
    with pytest.raises(CellFileError):
        load_cell_file("a\0b")
    (tmp_path / "round").symlink_to(tmp_path / "round")
    with pytest.raises(CellFileError):
        load_cell_file(tmp_path / "round")
    with pytest.raises(CellFileError):
        load_cell_file(tmp_path / ("x" * 5000))


# Configuration for the rest of the package.


def test_its_configuration_has_mounts_servoj_and_caps() -> None:
    edits: dict[str, Any] = {}
    for arm in ur10.ARMS:
        edits |= {f"{arm}__family": "e-series", f"{arm}__servoj": {"lookahead_s": 0.1, "gain": 300}}
    edits |= {"left__limits": {"speed_rad_s": 0.5, "tcp_speed_m_s": 0.4}, "right__limits": {"tcp_speed_m_s": 0.25}}
    edits |= {"left__calibration": {"theta_rad": [1e-3, 0, 0, 0, 0, 0]}, "right__tcp_position_m": [0.0, 0.1, 0.2]}
    cell = cell_of(GOOD, **edits)
    config = cell.config()
    assert config.servoj == ServojProfile("e-series", 0.1, 300.0)
    assert (config.left, config.right) == (cell.left.mount, cell.right.mount)
    assert config.left.dh.theta_rad[0] == 1e-3
    assert (config.speed_rad_s, config.tcp_speed_m_s) == (0.5, 0.25)
    assert config.tcp_m == (tuple(GOOD["left"]["tcp_position_m"]), (0.0, 0.1, 0.2))
    assert config.capped(MotionLimits()).tcp_m == config.tcp_m
    assert cell_of(GOOD, commissioned=True).config().speed_rad_s is None


def test_mounted_grippers_are_measured_in_every_task() -> None:
    gripper = {"right__gripper": {"kind": "digital_output", "output": 16}}
    bare, equipped = (cell_of(GOOD, **edits) for edits in ({}, gripper))
    assert not bare.config().grippers_mounted
    assert equipped.config().grippers_mounted
    assert equipped.simulated().grippers_mounted
    measured = []
    for cell in (bare, equipped):
        env = DualArmEnv("SineTracking", cell=cell.simulated())
        assert env.action_space.shape == (12,)  # nothing that it could open or close
        measured.append({pair for pair in env.core._clearance.pairs if {"left/fingers", "right/palm"} & set(pair)})
        env.close()
    assert not measured[0]
    assert ("right/palm", "table") in measured[1]
    low: dict[str, Any] = {"axis": "z", "center_m": ((0.0, 0.6, 0.3), (0.0, -0.6, 0.3))}
    DualArmEnv("SineTracking", cell=bare.simulated(), **low).close()
    with pytest.raises(SettingsError, match=r"sine's path .*/fingers and table come as close as"):
        DualArmEnv("SineTracking", cell=equipped.simulated(), **low)


def test_a_real_cell_is_slow_until_it_is_commissioned() -> None:
    limits = {"speed_rad_s": 1.5, "tcp_speed_m_s": 1.0}
    fast = edited(GOOD, left__limits=limits, right__limits=limits)
    for values in (GOOD, fast):
        config = cell_of(values).config()
        assert (config.speed_rad_s, config.tcp_speed_m_s) == (0.5, 0.25)
        assert (config.acceleration_rad_s2, config.jerk_rad_s3) == (None, None)
    tight = cell_of(GOOD, right__limits={"speed_rad_s": 0.1, "tcp_speed_m_s": 0.05}).config()
    assert (tight.speed_rad_s, tight.tcp_speed_m_s) == (0.1, 0.05)
    signed = cell_of(fast, commissioned=True).config()
    assert (signed.speed_rad_s, signed.tcp_speed_m_s) == (1.5, 1.0)
    emulated = cell_of(SMALL).config()
    assert (emulated.speed_rad_s, emulated.tcp_speed_m_s) == (None, None)


def test_notes_name_limits_beyond_those_of_first_runs() -> None:
    edits = {"left__limits": {"speed_rad_s": 0.6, "tcp_speed_m_s": 0.25}, "commissioned": True}
    notes = [each for each in cell_of(GOOD, **edits).notes() if "limits" in each]
    assert notes == [
        "left.limits.speed_rad_s is 0.6: first runs are made at 0.5 rad/s",
        "right.limits.speed_rad_s is missing: first runs are made at 0.5 rad/s",
        "right.limits.tcp_speed_m_s is missing: first runs are made at 0.25 m/s",
    ]
    text = "\n".join(cell_of(GOOD).notes())
    assert "commissioned is false: no arm exceeds 0.5 rad/s and 0.25 m/s" in text


def test_measured_figures_serve_compensation_and_simulation() -> None:
    bare = cell_of(GOOD)
    assert bare.config().measured_lookahead_s is None
    assert bare.simulated() == dataclasses.replace(bare.config(), kind="mujoco", file=None)
    edits: dict[str, Any] = {"left__measured": {"lookahead_s": 0.036, "latency_s": 0.004}}
    one = cell_of(GOOD, **edits)
    assert one.config().measured_lookahead_s == pytest.approx((0.036 + 0.03) / 2)
    assert one.config().perturbation == Perturbation()
    edits |= {"right__measured": {"lookahead_s": 0.045, "latency_s": 0.3}}
    cell = cell_of(GOOD, **edits)
    assert cell.config().measured_lookahead_s == pytest.approx(0.0405)
    found = cell.simulated()
    assert (found.kind, found.file, found.measured_lookahead_s) == ("mujoco", None, cell.config().measured_lookahead_s)
    assert found.perturbation.lookahead_scale == pytest.approx((1.2, 1.5))
    assert found.perturbation.latency_s == (0.004, 0.2)  # the most that a simulation takes


def test_the_environment_compensates_the_measured_lag() -> None:
    edits = {"left__measured": {"lookahead_s": 0.05}, "speed_factor": 1.0, "commissioned": True}
    cell = cell_of(GOOD, **edits).simulated()
    env = DualArmEnv("SineTracking", cell=cell)
    law = env.core.pipeline.adapter._matrices.law
    assert (law.lookahead_s, law.gain) == (0.04, cell.servoj.gain)
    env.close()


@pytest.mark.parametrize("value", [0.0, 0.6, float("nan"), "x"])
def test_a_measured_lookahead_has_bounds(value: Any) -> None:
    with pytest.raises(SettingsError, match="measured_lookahead_s of the cell is"):
        CellConfig(measured_lookahead_s=value)


def test_the_tighter_limits_of_both_arms_hold() -> None:
    tight = {"left__limits": {"speed_rad_s": 0.5, "jerk_rad_s3": 100}, "right__limits": {"acceleration_rad_s2": 3}}
    cell = cell_of(GOOD, **tight, right__limits__jerk_rad_s3=90, speed_factor=1.0, commissioned=True)
    upper = (1.0,) * 6
    found = cell.config().capped(MotionLimits(tcp_speed_m_s=1.2, upper_rad=upper))
    assert found.speed_rad_s == (0.5,) * 6
    assert (found.acceleration_rad_s2, found.jerk_rad_s3, found.tcp_speed_m_s) == (3.0, 90.0, 1.2)
    assert found.upper_rad == upper
    hard = MotionLimits()
    bare = edited(SMALL, left__family="cb3")
    assert cell_of(bare).config().capped(hard) == hard
    np.testing.assert_array_equal(hard.speed_rad_s, ur10.HARD_SPEED_RAD_S)


@pytest.mark.parametrize(
    ("edits", "words"),
    [
        ({"right__family": "e-series"}, r"right\.family is 'e-series' and left\.family is 'cb3'"),
        ({"right__servoj__gain": 1000}, r"right\.servoj\.gain is 1000.* and left\.servoj\.gain is 2000"),
        (
            {"left__servoj__lookahead_s": 0.1},
            r"right\.servoj\.lookahead_s is 0.03 and left\.servoj\.lookahead_s is 0.1",
        ),
    ],
)
def test_arms_that_differ_are_refused_for_now(edits: dict[str, Any], words: str) -> None:
    cell = cell_of(GOOD, **edits)
    with pytest.raises(CellFileError, match=rf"lab\.toml: {words}.*both arms need the same"):
        cell.config()


def test_notes_name_what_a_real_cell_leaves_out() -> None:
    text = "\n".join(cell_of(GOOD, speed_factor=0.5).notes())
    for word in (
        "left.calibration is",
        "right.calibration.checksum",
        "left.model is missing: the arm counts as a UR10",
        "left.serial_number",
        "left.safety_checksum",
        "speed_factor is 0.5",
    ):
        assert word in text
    sure: dict[str, Any] = {}
    for arm in ur10.ARMS:
        sure |= {
            f"{arm}__model": "ur10",
            f"{arm}__serial_number": "1",
            f"{arm}__safety_checksum": 1,
            f"{arm}__base_uncertainty_rad": 0.01,
        }
        sure |= {f"{arm}__calibration": {"theta_rad": [1e-4, 0, 0, 0, 0, 0], "checksum": [1] * 6}}
        sure |= {f"{arm}__limits": {"speed_rad_s": 0.5, "tcp_speed_m_s": 0.25}}
    sure |= {"commissioned": True}
    (note,) = cell_of(GOOD, **sure, right__gripper={"kind": "robotiq"}).notes()
    assert note.startswith("left.tcp_position_m is not at the flange and gripper is none: ")
    sure |= {f"{arm}__gripper": {"kind": "robotiq"} for arm in ur10.ARMS}
    assert cell_of(GOOD, **sure).notes() == []
    (note,) = cell_of(GOOD, **sure, right__base_tilt_rad=[0.01, 0.0]).notes()
    assert "right.base_tilt_rad is not 0: set the same mounting" in note
    assert cell_of(SMALL).notes() == []


# Template and documents.


@pytest.mark.parametrize("kind", ["real", "emulated"])
@pytest.mark.parametrize("family", ["cb3", "e-series"])
def test_the_template_is_legal_and_slow(tmp_path: Path, kind: Any, family: str) -> None:
    hosts = ("10.0.0.1", "10.0.0.2") if kind == "real" else (None, None)
    text = starting_text(kind, *hosts, family=family, task=ENV_IDS[1])
    cell = loaded(tmp_path, text)
    assert (cell.kind, cell.left.family, cell.right.family, cell.task) == (kind, family, family, ENV_IDS[1])
    assert cell.speed_factor == 0.25
    assert (cell.config().speed_rad_s, cell.config().tcp_speed_m_s) == (0.5, 0.25)
    assert all(line.startswith("#") for line in text[text.index(EXAMPLES) :].splitlines())
    explained = text[text.index("[left]") : text.index("[right]")].splitlines()
    assert all("  # " in line for line in explained if " = " in line)
    # The examples below are legal, too.
    extra = re.sub("^# ?", "", EXAMPLES.split("\n", 1)[1], flags=re.MULTILINE)
    more = loaded(tmp_path, text + extra)
    assert [each.kind for each in more.obstacles] == ["plane", "box", "capsule"]
    assert more.tracker == (AttachedTrackerEntry(prop="block", position_m=(0.0, 0.0, 0.17)),)


def test_a_real_cell_needs_addresses() -> None:
    with pytest.raises(CellFileError, match=r"the address of the right arm is missing.*--right"):
        starting_text("real", "10.0.0.1")
    with pytest.raises(CellFileError, match=r"x\.toml: left\.host is 127\.0\.0\.1"):
        starting_text("real", "127.0.0.1", "10.0.0.2", source="x.toml")


def test_existing_files_are_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    write_new(path, "first")
    for name in ("a.toml", "link.toml", "dangling.toml"):
        if name == "link.toml":
            (tmp_path / name).symlink_to(path)
        if name == "dangling.toml":
            (tmp_path / name).symlink_to(tmp_path / "elsewhere")
        with pytest.raises(CellFileError, match="exists: it was left as it is"):
            write_new(tmp_path / name, "second")
    assert path.read_text() == "first"
    assert not (tmp_path / "elsewhere").exists()
    with pytest.raises(DualUR10Error, match="does not exist"):
        write_new(tmp_path / "none" / "a.toml", "x")
    with pytest.raises(DualUR10Error):
        write_new(tmp_path, "x")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full disk")
def test_a_full_disk_leaves_no_half_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, real_open = tmp_path / "a.toml", Path.open

    def full(self: Path, *arguments: Any, **keywords: Any) -> Any:
        real_open(self, *arguments, **keywords).close()
        return Path("/dev/full").open("w", buffering=1)

    with monkeypatch.context() as patch:
        patch.setattr(
            type(path), "open", lambda self, *a, **k: full(self, *a, **k) if self == path else real_open(self, *a, **k)
        )
        with pytest.raises(DualUR10Error, match="cannot write"):
            write_new(path, "text\n")
    assert not path.exists()


def test_every_sample_is_legal() -> None:
    for key in keys().keys:
        value, schema = tomllib.loads(key.sample)[key.name], key.single
        many = value if key.count else [value]
        assert len(many) == max(1, key.count), key
        for each in many:
            if schema["type"] in ("number", "integer"):
                assert schema["minimum"] <= each <= schema["maximum"], key
            else:
                assert each in schema.get("enum", [each]), key


def test_units_are_in_the_names() -> None:
    bare = {
        "kind",
        "name",
        "task",
        "speed_factor",
        "rt_priority",
        "host",
        "family",
        "model",
        "serial_number",
        "port",
        "pid",
    }
    bare |= {
        "commissioned",
        "allow_reduced_mode",
        "output",
        "open_level",
        "tool",
        "gain",
        "checksum",
        "safety_checksum",
        "arm",
        "prop",
        "tracker",
        "driver",
        "options",
        "settings",
        "normal",
        "up",
        "body",
        "file",
        "repeat",
        "width",
        "height",
        "device",
        "format",
        "camera",
        "date",
        "data",
    }  # numbers without a unit, and texts
    for key in keys().keys:
        assert key.name in bare or re.search(r"_(m|rad|kg|s|s2|s3|hz)$", key.name), key.path


def test_the_reference_page_lists_every_key() -> None:
    found = [re.split(r"(?<!\\) \| ", line) for line in reference_page().splitlines() if line.startswith("| `")]
    assert [row[0] for row in found] == [
        f"| `{each.path}`" + f" ({each.variant})" * bool(each.variant) for each in keys().keys
    ]
    assert all(len(row) == 5 and all(row) for row in found)
    assert (
        "| `ARM.host` | address of the controller | an IPv4 address; names are not looked up | yes | — |"
        in reference_page()
    )


def test_the_json_schema_accepts_what_the_reader_accepts() -> None:
    schema = CellFile.model_json_schema()
    assert schema["additionalProperties"] is False
    assert set(schema["required"]) == {"kind", "left", "right"}
    assert [each.path for each in keys().keys if not each.schema["description"]] == []


def test_the_documents_example_is_legal(tmp_path: Path) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "how-to" / "cell-file.md").read_text(), re.DOTALL)
    assert blocks
    for block in blocks:
        assert loaded(tmp_path, block).kind == "real"


def test_the_error_is_a_settings_error() -> None:
    assert issubclass(CellFileError, SettingsError)


def test_a_file_of_a_task_that_is_not_installed_can_be_read(tmp_path: Path) -> None:
    """Else its latched stop could not be cleared."""
    cell = cell_of(SMALL, task="MyLab/Peg-v3", emulator={"port": 4000, "task": "MyLab/Peg-v3"})
    assert (cell.task, cell.emulator.task) == ("MyLab/Peg-v3", "MyLab/Peg-v3")
    for wrong in ("DualUR10/Peg-v3", "Peg", "MyLab/Peg"):
        assert "the id of an environment" in refused(tmp_path, edited(SMALL, task=wrong))
