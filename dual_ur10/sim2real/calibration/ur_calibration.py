"""Kinematics of an arm from the YAML of Universal Robots' calibration extraction.

That file has the pose of each link's frame in the frame before, as URDF has it. Any pose between two joint axes is
`Rz(b) Tz(d) Tx(a) Rx(alpha) Rz(c) Tz(e)`, so that the chain is a Denavit-Hartenberg chain exactly, if the first axis is
that of the base. Axes that are parallel leave d free: it is 0 then.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from dual_ur10.errors import CalibrationError, SettingsError
from dual_ur10.sim2real.calibration.transforms import flange, rotation_of, transform
from dual_ur10.yaml_documents import documents
from ur_core.files import read_named
from ur_core.kinematics.ur10 import DHParameters
from ur_core.types import Array

FRAMES: Final = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")

_MAX_BYTES: Final = 64 * 1024
_PARALLEL: Final = 1e-9
_OFF_BASE: Final = 1e-7  # m and rad
_EXACT: Final = 1e-7  # m and rad


class _Frame(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    x: float
    y: float
    z: float
    roll: float
    pitch: float
    yaw: float

    @property
    def pose(self) -> Array:
        """(4, 4) pose: roll about x, then pitch about y, then yaw about z, all of them fixed axes."""
        axes = np.diag([self.roll, self.pitch, self.yaw])
        x, y, z = rotation_of(axes)
        return transform((self.x, self.y, self.z), z @ y @ x)


_FILE: Final = TypeAdapter(dict[str, _Frame])


def read(path: str | Path, robot: str) -> DHParameters:
    """Read the kinematics of an arm.

    Args:
        path: File of UR's calibration tool.
        robot: Model of the arm, a name in `ur_core.kinematics.robots.ROBOTS`.

    Raises:
        CalibrationError: The file cannot be read, or holds no such kinematics.
        SettingsError: The kinematics are those of another robot.
    """
    path = Path(path)
    content = read_named(path, _MAX_BYTES, CalibrationError, remedy="Correct the name")
    if len(content) > _MAX_BYTES:
        raise CalibrationError(f"{path} is longer than {_MAX_BYTES} bytes: name the file of a calibration")
    try:
        found = documents(content, "calibration", "a calibration in YAML")
    except (RecursionError, ValueError) as error:
        raise CalibrationError(f"{path} is no YAML: {' '.join(str(error).split())[:200]}") from None
    if len(found) > 1:
        raise CalibrationError(f"{path} has {len(found)} documents: it must be that of one arm")
    return of_frames(_frames(found[0] if found else None, str(path)), robot)


def _frames(values: Any, source: str) -> list[Array]:
    kinematics = values.get("kinematics") if isinstance(values, dict) else None
    if not isinstance(kinematics, dict) or not set(FRAMES) <= set(kinematics):
        raise CalibrationError(
            f"{source} has no `kinematics` of {', '.join(FRAMES)}: name the file that `ur_calibration` wrote"
        )
    try:
        frames = _FILE.validate_python({name: kinematics[name] for name in FRAMES}, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise CalibrationError(f"{source}: kinematics {' '.join(map(str, first['loc']))}: {first['msg']}") from None
    return [frames[name].pose for name in FRAMES]


def of_frames(frames: list[Array], robot: str) -> DHParameters:
    """Return the Denavit-Hartenberg parameters of a chain of link frames.

    Args:
        frames: Six poses (4, 4): each frame, whose z axis is a joint's, in the one before.
        robot: Model of the arm, a name in `ur_core.kinematics.robots.ROBOTS`.

    Raises:
        CalibrationError: The first axis is not that of the base, or the conversion is not exact.
        SettingsError: They are not those of this model.
    """
    first = frames[0]
    off = np.append(first[:2, 3], first[:2, 2])
    if np.abs(off).max() > _OFF_BASE:
        raise CalibrationError(
            f"the axis of the first joint is {np.linalg.norm(off[:2]):.3g} m and {np.linalg.norm(off[2:]):.3g} rad off "
            "the z axis of the base: the Denavit-Hartenberg chain used here cannot express that. Extract the "
            "calibration from the controller again, or read it with `--kinematics ARM=controller`"
        )
    theta, d, a, alpha = np.zeros((4, 6))
    theta[0], d[0] = np.arctan2(first[1, 0], first[0, 0]), first[2, 3]
    for joint in range(5):
        before, d_m, a_m, twist, after, e_m = _between(frames[joint + 1])
        theta[joint] += before
        d[joint] += d_m
        a[joint], alpha[joint] = a_m, twist
        theta[joint + 1] += after
        d[joint + 1] += e_m
    theta = np.remainder(theta + np.pi, 2 * np.pi) - np.pi
    parameters = DHParameters(
        tuple(a.tolist()), tuple(d.tolist()), tuple(alpha.tolist()), tuple(theta.tolist()), robot=robot
    )
    _check_exact(frames, parameters)
    return parameters


def _between(pose: Array) -> tuple[float, float, float, float, float, float]:
    """Return b, d, a, alpha, c and e of a pose; of both solutions the one whose b is nearest to 0."""
    axis, place = pose[:3, 2], pose[:3, 3]
    across = np.array([-axis[1], axis[0]])  # the common normal of both z axes
    sine = float(np.hypot(*across))
    if sine < _PARALLEL:
        across = place[:2] if np.hypot(*place[:2]) > _PARALLEL else np.array([1.0, 0.0])
    normal = across / np.hypot(*across)
    if normal[0] < 0.0:
        normal = -normal
    before = float(np.arctan2(normal[1], normal[0]))
    along = np.array([*normal, 0.0])
    alpha = float(np.arctan2(np.cross([0.0, 0.0, 1.0], axis) @ along, axis[2]))
    if sine < _PARALLEL:
        d, a, e = float(place[2]), float(place @ along), 0.0
    else:
        d, a, e = map(float, np.linalg.solve(np.stack([[0.0, 0.0, 1.0], along, axis], axis=1), place))
    rest = rotation_of((alpha, 0.0, 0.0)).T @ rotation_of((0.0, 0.0, before)).T @ pose[:3, :3]
    return before, d, a, alpha, float(np.arctan2(rest[1, 0], rest[0, 0])), e


def _check_exact(frames: list[Array], parameters: DHParameters) -> None:
    """Compare both chains at some configurations."""
    for q in np.linspace(-2.5, 2.5, 7)[:, None] * np.array([1.0, -0.7, 0.9, -1.1, 0.6, 1.3]):
        chain = np.eye(4)
        for frame, angle in zip(frames, q, strict=True):
            chain = chain @ frame @ transform(np.zeros(3), rotation_of((0.0, 0.0, angle)))
        off = float(np.abs(flange(q, parameters) - chain).max())
        if not off < _EXACT:
            raise CalibrationError(
                f"the kinematics differ by {off:.3g} m or rad after their conversion: read the calibration from the "
                "controller with `--kinematics ARM=controller`"
            )


__all__ = ["FRAMES", "SettingsError", "of_frames", "read"]
