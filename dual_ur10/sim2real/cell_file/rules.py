"""Rules between the values of a cell file, beyond the range of each."""

from __future__ import annotations

import ipaddress
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

import numpy as np

from dual_ur10.assets.settings import SceneSettings
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.sim2real.cell.cell_config import LEAST_DAMPING
from dual_ur10.sim2real.cell_file.tables import (
    LEVEL,
    ZERO,
    ArmEntry,
    EmulatedCameraEntry,
    EmulatedTrackerEntry,
    Kind,
    NoGripper,
    PlaneEntry,
)
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.rotations import quat_conjugate, quat_multiply, quat_to_rotvec, rotate
from ur_core.kinematics.ur10 import ARMS
from ur_core.tools.tool import tool_named

if TYPE_CHECKING:
    from dual_ur10.sim2real.cell_file.cell_file import CellFile

_UNIT_TOLERANCE: Final = 1e-3
_BEHIND_M: Final = 0.01
_CALIBRATED: Final = 1e-6  # m and rad, as many digits as are written


def inconsistencies(cell: CellFile) -> Iterator[str]:
    """Yield a finding for each pair of values of a cell file that contradict each other, with its remedy."""
    emulated = cell.kind == "emulated"
    for name, arm in zip(ARMS, cell.arms, strict=True):
        yield from _host_fits(cell.kind, f"{name}.host", arm.host)
    if cell.left.host == cell.right.host:
        yield (
            f"right.host is {cell.right.host}, as left.host is: each arm has a controller of its own. "
            "Write both addresses as the controllers show them"
        )
    yield from _bases(cell)
    yield from _calibrated(cell)
    for name, arm in zip(ARMS, cell.arms, strict=True):
        yield from _servoj(name, arm)
        yield from _model(name, arm)
        yield from _tool(name, arm)
    if cell.emulator is not None and not emulated:
        yield 'emulator is in the file of a real cell: it is allowed with kind = "emulated" only. Take the table out'
    for index, entry in enumerate(cell.tracker):
        if isinstance(entry, EmulatedTrackerEntry) and (not emulated or cell.emulator is None):
            yield (
                f'tracker[{index}].kind is "emulated": only an emulated cell has such a camera, at the address in the '
                'table [emulator]. Use "attached", "given" or "own", or the file that `emulate --cell` writes'
            )
    props = [each.prop for each in cell.tracker]
    for prop in sorted({each for each in props if props.count(each) > 1}):
        yield f"two trackers are of the prop {prop!r}: take one out"
    yield from _cameras(cell)
    yield from _obstacles(cell)


def _host_fits(kind: Kind, path: str, host: str) -> Iterator[str]:
    address = ipaddress.IPv4Address(host)
    if kind == "emulated" and not address.is_loopback:
        yield (
            f'{path} is {host} with kind = "emulated": emulated controllers have loopback addresses, 127.0.0.0/8. '
            'If a robot is there, write kind = "real"'
        )
    elif kind == "real" and address.is_loopback:
        yield (
            f'{path} is {host} with kind = "real": no robot is at a loopback address. Write its own address, or '
            'kind = "emulated"'
        )
    elif kind == "real" and (address.is_unspecified or address.is_multicast or address.is_reserved):
        yield f"{path} is {host}: no single machine has this address. Write the one that the controller shows"


def _bases(cell: CellFile) -> Iterator[str]:
    mounts = []
    for name, arm in zip(ARMS, cell.arms, strict=True):
        try:
            mounts.append(arm.mount)
        except SettingsError as error:
            where = "calibration" if "DH" in str(error) else "base_position_m"
            yield f"{name}.{where}: {error}. Write the figures of this arm"
    if len(mounts) == 2:
        try:
            SceneSettings(left=mounts[0], right=mounts[1])
        except SettingsError as error:
            yield f"left.base_position_m and right.base_position_m: {error}. Write where the bases stand"


def _calibrated(cell: CellFile) -> Iterator[str]:
    found = cell.base_to_base
    if found is None:
        return
    try:
        left, right = cell.left.mount, cell.right.mount
        wanted = ArmMount(ZERO, found.yaw_rad, tilt_rad=found.tilt_rad or LEVEL)
    except SettingsError:
        return  # reported already
    back = quat_conjugate(left.quat)
    off_m = math.dist(rotate(back, np.subtract(right.position_m, left.position_m)), found.position_m)
    relative = quat_multiply(back, right.quat)
    off_rad = float(np.linalg.norm(quat_to_rotvec(quat_multiply(quat_conjugate(wanted.quat), relative))))
    if off_m > _CALIBRATED or off_rad > _CALIBRATED:
        yield (
            f"base_to_base: the bases stand {1e3 * off_m:.3g} mm and {off_rad:.3g} rad otherwise than calibrated on "
            f"{found.date}: calibrate again with `cell calibrate`, or take this table out"
        )


def _model(name: str, arm: ArmEntry) -> Iterator[str]:
    facts = robot_model(arm.robot)
    if facts.family != arm.family:
        yield (
            f"{name}.model is {arm.robot!r} and {name}.family is {arm.family!r}: the controller of a {facts.title} is "
            f"of the family {facts.family!r}. Correct one of them"
        )
    slowest = float(facts.hard_speed_rad_s.min())
    if (arm.limits.speed_rad_s or 0.0) > slowest:
        yield (
            f"{name}.limits.speed_rad_s is {arm.limits.speed_rad_s:g}: the hard limit of the slowest joint of a "
            f"{facts.title} is {slowest:g} rad/s. Correct it, or the model; without the key the hard limits hold"
        )
    if (arm.payload_kg or 0.0) > facts.payload_kg:
        yield (
            f"{name}.payload_kg is {arm.payload_kg:g}: a {facts.title} may carry 0 to {facts.payload_kg:g} kg. "
            "Correct it, or the model"
        )


def _servoj(name: str, arm: ArmEntry) -> Iterator[str]:
    profile = arm.profile
    if profile.damping < LEAST_DAMPING:
        least = (2 * LEAST_DAMPING / profile.lookahead_s) ** 2
        yield (
            f"{name}.servoj.gain is {profile.gain:g} with lookahead_s = {profile.lookahead_s:g}: the arm would swing "
            f"(damping {profile.damping:.2f}, allowed is {LEAST_DAMPING} or more). Choose a gain of {math.ceil(least)} "
            "or more, or a longer lookahead"
        )


def _tool(name: str, arm: ArmEntry) -> Iterator[str]:
    if isinstance(arm.gripper, NoGripper):
        return
    try:
        tool = tool_named(arm.gripper.tool)
    except (SettingsError, UnknownNameError) as error:
        yield f"{name}.gripper.tool: {error}"
        return
    # A driver of one's own states itself what it drives, once it is loaded.
    if arm.gripper.kind not in (*tool.drivers, "own"):
        yield (
            f"{name}.gripper.kind is {arm.gripper.kind!r}, which cannot drive the tool {tool.name!r}: use "
            f"{' or '.join(map(repr, tool.drivers))}, or name the tool at the flange"
        )


def _cameras(cell: CellFile) -> Iterator[str]:
    names = [each.name for each in cell.camera]
    for name in sorted({each for each in names if names.count(each) > 1}):
        yield f"two cameras are named {name!r}: give each a name of its own"
    for index, entry in enumerate(cell.camera):
        path = f"camera[{index}]"
        if isinstance(entry, EmulatedCameraEntry) and (cell.kind != "emulated" or cell.emulator is None):
            yield (
                f'{path}.kind is "emulated": only an emulated cell has such a camera, at the address in the table '
                '[emulator]. Use "v4l2", "file", "pattern" or "own", or the file that `emulate --cell` writes'
            )
        if (entry.position_m is None) is not (entry.target_m is None):
            yield f"{path} has one of position_m and target_m: state both, or neither"
        try:
            _ = entry.mounted
        except SettingsError as error:
            yield f"{path}: {error}"


def _obstacles(cell: CellFile) -> Iterator[str]:
    seen: dict[str, int] = {}
    for row, each in enumerate(cell.obstacle):
        path = f"obstacle[{row}]"
        if each.name in seen:
            yield f"{path}.name is {each.name!r}, as that of obstacle[{seen[each.name]}]: choose another"
        seen.setdefault(each.name, row)
        if not isinstance(each, PlaneEntry):
            continue
        length = math.hypot(*each.normal)
        if abs(length - 1) > _UNIT_TOLERANCE:
            yield f"{path}.normal has the length {length:.6g}: allowed is 1. Divide it by its length"
            continue
        for name, arm in zip(ARMS, cell.arms, strict=True):
            away = (a - b for a, b in zip(arm.base_position_m or ZERO, each.point_m, strict=True))
            ahead_m = sum(a * b for a, b in zip(each.normal, away, strict=True))
            if ahead_m < -_BEHIND_M:
                yield (
                    f"{path}.normal points away from the {name} base, which is {-ahead_m:.3g} m behind the plane: the "
                    "arms are in front of it. Turn the normal round, or move the point"
                )
