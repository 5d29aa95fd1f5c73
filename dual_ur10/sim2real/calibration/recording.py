"""Joint angles of arms at rest, read from their controllers, and touches of emulated arms; nothing is commanded."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from dual_ur10.errors import CalibrationError, EmulatorError, LinkError
from dual_ur10.sim2real.calibration.observations import JointAngles, Noise, Touch
from dual_ur10.sim2real.calibration.transforms import flange, inverse_of, transform
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from ur_core.kinematics.inverse import nearest
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.kinematics.ur10 import ARMS, DHParameters
from ur_core.links.json_link import JsonLink
from ur_core.links.rtde_link import RtdeLink
from ur_core.processes.system import LOCAL, System
from ur_core.types import Array

_POSITION, _SPEED = "actual_q", "actual_qd"
_RATE_HZ: Final = 25.0
_DURATION_S: Final = 0.5
_POLL_S: Final = 0.04
_LEAST: Final = 5  # samples
_AT_REST_RAD_S: Final = 0.01
_STEADY_RAD: Final = 1e-3  # 1 mm at 1 m: hands let go meanwhile


def read_joints(file: CellFile, *, system: System = LOCAL) -> tuple[JointAngles, JointAngles]:
    """Return the mean joint angles of the left and the right arm over half a second.

    Args:
        file: The cell file.
        system: Clock and network.

    Raises:
        CalibrationError: An arm moves.
        LinkError: A controller cannot be reached, or sends too few samples.
    """
    samples: list[list[Any]] = [[], []]
    with _link(file, 0, system) as left, _link(file, 1, system) as right:
        end_s = system.clock.now_s() + _DURATION_S
        while system.clock.now_s() < end_s:
            system.clock.sleep(_POLL_S)
            for found, link in zip(samples, (left, right), strict=True):
                found += [(each.values[_POSITION], each.values[_SPEED]) for each in link.poll()]
    first, second = (_mean(name, found) for name, found in zip(ARMS, samples, strict=True))
    return first, second


def _link(file: CellFile, arm: int, system: System) -> RtdeLink:
    return RtdeLink(file.arms[arm].host, (_POSITION, _SPEED), _RATE_HZ, name=ARMS[arm], system=system)


def _mean(name: str, samples: list[Any]) -> JointAngles:
    if len(samples) < _LEAST:
        raise LinkError(
            f"{name}: {len(samples)} samples in {_DURATION_S:g} s, {_LEAST} are needed: check controller and network"
        )
    q, speed = np.asarray(samples).transpose(1, 0, 2)
    if np.abs(speed).max() > _AT_REST_RAD_S or np.ptp(q, axis=0).max() > _STEADY_RAD:
        raise CalibrationError(
            f"the {name} arm moves ({np.abs(speed).max():.2g} rad/s, {np.ptp(q, axis=0).max():.2g} rad): nothing was "
            "recorded. End freedrive or hold it still, then try again"
        )
    joints: JointAngles = tuple(q.mean(axis=0).tolist())
    return joints


def emulated_base(file: CellFile, *, system: System = LOCAL) -> Array:
    """Return the true pose (4, 4) of the right base in the left one of a running emulated cell.

    Raises:
        CalibrationError: The cell file is not that of an emulated cell.
        EmulatorError: The cell gives no answer.
    """
    if file.kind != "emulated" or file.emulator is None:
        raise CalibrationError(
            f"{file.source} is no file of an emulated cell: only there touches can be simulated. Record those of real "
            "arms with `--record touch`"
        )
    half_turn = transform(np.zeros(3), np.diag([-1.0, -1.0, 1.0]))
    poses = []
    try:
        with JsonLink("fault injection", file.left.host, file.emulator.port, system=system) as link:
            for arm in ARMS:
                found = link.ask("pose", body=f"{arm}/base_link")
                poses.append(transform(found["position_m"], quat_to_matrix(found["quat"])) @ half_turn)
    except (LinkError, OSError) as error:
        raise EmulatorError(f"{error}. Start the cell with `python -m dual_ur10 emulate --cell FILE`") from error
    return inverse_of(poses[0]) @ poses[1]


def touched(
    planned: Touch, dh: tuple[DHParameters, DHParameters], base: Array, noise: Noise, rng: np.random.Generator
) -> Touch:
    """Return a touch as measured: the right tip is brought to the left one, up to the noise.

    Args:
        planned: Its left joint angles and tools are taken, and the right tool's orientation.
        dh: True kinematics of both arms.
        base: (4, 4) true pose of the right base in the left one.
        noise: Standard deviations.
        rng: Source of the noise.

    Raises:
        UnreachableError: The right arm does not reach the point.
    """
    point = flange(planned.left_q_rad, dh[0]) @ [*planned.left_tcp_m, 1.0]
    point[:3] += rng.normal(0.0, noise.touch_m, 3)
    tool = flange(planned.right_q_rad, dh[1])[:3, :3]
    at = (inverse_of(base) @ point)[:3] - tool @ np.asarray(planned.right_tcp_m)
    right = nearest(at, tool, np.asarray(planned.right_q_rad), dh[1])
    return Touch(planned.left_q_rad, tuple(right.tolist()), planned.left_tcp_m, planned.right_tcp_m)
