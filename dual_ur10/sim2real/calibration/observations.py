"""Observations that relate both bases, and their noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

from dual_ur10.errors import CalibrationError, SettingsError
from ur_core.kinematics.frames import finite_floats
from ur_core.types import Vector3

Carrier = Literal["left", "right", "fixed"]
"""What a camera or a board is mounted on: the flange of an arm, or the surroundings."""

JointAngles = tuple[float, float, float, float, float, float]

_ZERO: Final = (0.0, 0.0, 0.0)
_MOST_RAD: Final = 2 * math.pi + 0.01  # the joint range, and the noise of a measurement at its end
_MOST_TCP_M: Final = 1.0
_MOST_BOARD_M: Final = 10.0


@dataclass(frozen=True)
class Touch:
    """One point, touched by the tool centre points of both arms.

    Attributes:
        left_q_rad, right_q_rad: (6,) joint angles.
        left_tcp_m, right_tcp_m: (3,) tool centre points in the flange frames.

    Raises:
        CalibrationError: A value is not finite or out of range.
    """

    left_q_rad: JointAngles
    right_q_rad: JointAngles
    left_tcp_m: Vector3 = _ZERO
    right_tcp_m: Vector3 = _ZERO

    def __post_init__(self) -> None:
        _check_joints(self)
        for name in ("left_tcp_m", "right_tcp_m"):
            _set(self, name, 3, _MOST_TCP_M)

    def exchanged(self, *, tips: bool) -> Touch:
        """Return the touch with the arms' joint angles exchanged, and their tips if so wanted."""
        left_m, right_m = (self.right_tcp_m, self.left_tcp_m) if tips else (self.left_tcp_m, self.right_tcp_m)
        return Touch(self.right_q_rad, self.left_q_rad, left_m, right_m)


@dataclass(frozen=True)
class BarPose:
    """Both hands on one rigid bar: the pose of one flange in the other's frame is unknown and constant.

    Attributes:
        left_q_rad, right_q_rad: (6,) joint angles.
        grasp: Name of the grasp. After a hand has let go of the bar, the constant pose is another one.

    Raises:
        CalibrationError: A value is not finite or out of range.
    """

    left_q_rad: JointAngles
    right_q_rad: JointAngles
    grasp: str = "1"

    def __post_init__(self) -> None:
        _check_joints(self)

    def exchanged(self, *, tips: bool) -> BarPose:
        """Return the pose with the arms exchanged; a bar has no tips."""
        return BarPose(self.right_q_rad, self.left_q_rad, self.grasp)


@dataclass(frozen=True)
class BoardView:
    """Pose of a board of markers in the frame of a camera.

    Attributes:
        camera_on, board_on: What they are mounted on: not the same.
        left_q_rad, right_q_rad: (6,) joint angles; None where that arm carries neither of them.
        position_m: (3,) position of the board in the camera's frame.
        rotation_rad: (3,) its orientation there, a rotation vector.

    Raises:
        CalibrationError: A value is not finite or out of range, or joint angles are missing.
    """

    camera_on: Carrier
    board_on: Carrier
    left_q_rad: JointAngles | None
    right_q_rad: JointAngles | None
    position_m: Vector3
    rotation_rad: Vector3

    def __post_init__(self) -> None:
        if self.camera_on == self.board_on:
            raise CalibrationError(
                f"camera and board are both on {self.camera_on!r}: such a view relates no arms. Mount one of them "
                "elsewhere"
            )
        for arm in ("left", "right"):
            if arm in (self.camera_on, self.board_on) and getattr(self, f"{arm}_q_rad") is None:
                raise CalibrationError(f"a view of a board needs {arm}_q_rad: the {arm} arm carries a part of it")
        _check_joints(self)
        _set(self, "position_m", 3, _MOST_BOARD_M)
        _set(self, "rotation_rad", 3, _MOST_RAD)

    def exchanged(self, *, tips: bool) -> BoardView:
        """Return the view with the arms' joint angles exchanged, and what carries camera and board with `tips`.

        Raises:
            CalibrationError: The arm that carries a part then has no joint angles.
        """
        others: dict[Carrier, Carrier] = {"left": "right", "right": "left", "fixed": "fixed"}
        carriers = (self.camera_on, self.board_on)
        camera, board = (others[each] if tips else each for each in carriers)
        return replace(self, camera_on=camera, board_on=board, left_q_rad=self.right_q_rad, right_q_rad=self.left_q_rad)


Observation = Touch | BarPose | BoardView


def _check_joints(observation: Any) -> None:
    for name in ("left_q_rad", "right_q_rad"):
        if getattr(observation, name) is not None:
            _set(observation, name, 6, _MOST_RAD)


def _set(observation: Any, name: str, length: int, most: float) -> None:
    """Replace a vector by plain finite floats."""
    try:
        values = finite_floats(name, getattr(observation, name), length)
    except SettingsError as error:
        raise CalibrationError(f"{error}. Measure it again") from None
    if max(map(abs, values)) > most:
        raise CalibrationError(f"{name} is {values}: allowed are ±{most:.3g} for each number. Check the units: m, rad")
    object.__setattr__(observation, name, values)


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the observations, along or about any axis.

    Their ratios weight the kinds of observations; the scale of all together follows from the residuals.

    Attributes:
        touch_m: Between both tips at a touch. A UR10 repeats a pose within 0.1 mm.
        bar_m, bar_rad: Of the bar in each hand: play of the grasp and yielding of the arm.
        board_m, board_rad: Pose of a board in a camera's frame.

    Raises:
        CalibrationError: A value is not between 1 nm and 0.1 m, or 1 nrad and 0.1 rad.
    """

    touch_m: float = 1e-4
    bar_m: float = 5e-5
    bar_rad: float = 1e-4
    board_m: float = 5e-4
    board_rad: float = 1e-3

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not 1e-9 <= value <= 0.1:
                raise CalibrationError(f"noise {name} is {value!r}: allowed are 1e-9 to 0.1, in m or rad")
