"""Named fields of an observation: the only place where the position of a number in it is written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from dual_ur10.errors import ActionError, SettingsError, UnknownNameError
from dual_ur10.sim2real.cell.cell import CellState
from ur_core.kinematics.poses import Poses
from ur_core.types import Array, Single, constant


@dataclass(frozen=True)
class Field:
    """One quantity in the observation of an arm.

    Attributes:
        name: Key in `ObservationLayout.split`.
        size: Number of values.
        low, high: Bounds of each value.
        unit: Type and unit, as in the table of the task's docstring.
        description: Quantity, as in that table.
        mujoco: Name in the MJCF model, with "{arm}" for the arm and "{other}" for the other one; "-": none.
        concise: Units of the field in the concise view, `observation="goals"`; (): it is not in it. See `ConciseView`.
    """

    name: str
    size: int
    low: float
    high: float
    unit: str
    description: str
    mujoco: str = "-"
    concise: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not all(unit > 0.0 for unit in self.concise):
            raise SettingsError(f"concise of the field {self.name!r} is {self.concise!r}: units are above 0")


_WIDTHS: Final = ("gripper_m", "other_gripper_m")
_WIDTH_ROOM: Final = 1.15  # times the stroke: fingers yield, and their widths are measured with an error


class ObservationLayout:
    """Fields of one arm in their order. An observation holds those of the left arm, then those of the right arm.

    Args:
        *fields: Fields of one arm.

    Attributes:
        fields: As given.
        size: Number of values of one arm.
        low, high: (2 * size,) bounds of an observation.
    """

    def __init__(self, *fields: Field) -> None:
        self.fields = fields
        ends = np.cumsum([field.size for field in fields]).tolist()
        self._slices = {field.name: slice(end - field.size, end) for field, end in zip(fields, ends, strict=True)}
        self.size: int = ends[-1]
        sizes = [field.size for field in fields]
        self.low = constant(np.tile(np.repeat([field.low for field in fields], sizes), 2))
        self.high = constant(np.tile(np.repeat([field.high for field in fields], sizes), 2))

    def __repr__(self) -> str:
        fields = ", ".join(f"{field.name} {field.size}" for field in self.fields)
        return f"{type(self).__name__}({self.size} numbers of an arm: {fields})"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fields in their order."""
        return tuple(self._slices)

    def without(self, *names: str) -> ObservationLayout:
        """Return a layout that lacks some fields."""
        return ObservationLayout(*(field for field in self.fields if field.name not in names))

    def with_stroke(self, stroke_m: float) -> ObservationLayout:
        """Return the layout with bounds for gripper widths up to a stroke: the layout itself, if it has them."""
        most = _WIDTH_ROOM * stroke_m
        if not any(field.name in _WIDTHS and field.high < most for field in self.fields):
            return self
        wider = (replace(field, low=-most, high=most) if field.name in _WIDTHS else field for field in self.fields)
        return ObservationLayout(*wider)

    def join(self, values: Mapping[str, Array]) -> Array:
        """Assemble observations, (n, 2 * size), from fields, (n, 2, field size) each."""
        parts = [values[name] for name in self._slices]
        return np.concatenate(parts, axis=2).reshape(len(parts[0]), -1)

    def split(self, observation: Array) -> dict[str, Array]:
        """Return views of the fields, (..., 2, field size) each, of observations, (..., 2 * size)."""
        arms = observation.reshape(*observation.shape[:-1], 2, self.size)
        return {name: arms[..., part] for name, part in self._slices.items()}

    def batch(self, observation: object, task: str) -> Array:
        """Return an observation, or a batch of them, as a batch of float64, (n, 2 * size).

        Raises:
            ActionError: The shape is not that of an observation of `task`.
        """
        array = np.asarray(observation, dtype=np.float64)
        size = 2 * self.size
        if array.shape[-1:] != (size,) or array.ndim > 2:
            raise ActionError(f"an observation of {task} has shape ({size},) or (n, {size}), found {array.shape}")
        return array.reshape(-1, size)

    def indices(self, names: Iterable[str]) -> list[int]:
        """Return the positions of the values of some fields among those of one arm, in ascending order.

        Raises:
            UnknownNameError: There is no such field.
        """
        found: set[int] = set()
        for name in names:
            if name not in self._slices:
                raise UnknownNameError("observation field", name, self.names)
            found.update(range(self.size)[self._slices[name]])
        return sorted(found)

    def table(self) -> list[str]:
        """Return the rows of the left arm for the table in a task's docstring."""
        return [
            f"| {_range(self._slices[field.name])} | {field.description} | {field.low:g} | {field.high:g} | "
            f"{field.mujoco.format(arm='left', other='right')} | {field.unit} |"
            for field in self.fields
        ]


_POSTURE: Final = "commanded_q_rad"


class ConciseView:
    """Concise view of observations, `observation="goals"`: few numbers between -1 and 1, of which none is saturated.

    For each unit u of a field (`Field.concise`) it has x / (u + |x|) of each value x, which is about x / u near 0 and a
    half at u. A small unit shows small values well, and a large one tells large ones apart. The first six are the
    commanded joint positions from home, in units of 1 rad.

    Args:
        layout: Fields of an arm.
        home_q_rad: (2, 6) home position of the joints.
        task: Name of the task, for the error.

    Attributes:
        layout: Fields of the view. One with several units holds its values in the first unit, then in the next.

    Raises:
        SettingsError: The layout marks no field.
    """

    def __init__(self, layout: ObservationLayout, home_q_rad: Array, task: str) -> None:
        if not any(field.concise for field in layout.fields):
            raise SettingsError(
                f"observation is 'goals', and {task} marks no field of its layout for it: give those that lead to its "
                "goal their units, Field(..., concise=(0.1, 0.01)), or use observation='state'"
            )
        shown = [field for field in layout.fields if field.concise and field.name != _POSTURE]
        shown = [replace(each, concise=(1.0,)) for each in layout.fields if each.name == _POSTURE] + shown
        self.layout = ObservationLayout(*map(_shown, shown))
        self._index = np.array([index for each in shown for index in layout.indices([each.name]) * len(each.concise)])
        self._unit = np.concatenate([np.repeat(each.concise, each.size) for each in shown])
        self._origin = np.zeros((2, self.layout.size))
        if shown[0].name == _POSTURE:
            self._origin[:, :6] = home_q_rad

    def __call__(self, observation: Array) -> Single:
        """Return the view, (n, 2 * layout.size), of observations, (n, 2 * size)."""
        away = observation.reshape(len(observation), 2, -1).take(self._index, axis=2) - self._origin
        away /= self._unit + np.abs(away)
        return away.reshape(len(observation), -1).astype(np.float32)

    def commanded_q_rad(self, view: Array) -> Array:
        """Return the commanded joint positions, (n, 2, 6), that views, (n, 2 * layout.size), show."""
        shown = np.asarray(view, dtype=np.float64).reshape(len(view), 2, -1)[..., :6]
        found: Array = self._origin[:, :6] + shown / (1.0 - np.abs(shown))
        return found


def _shown(field: Field) -> Field:
    """Return a field as it is in the concise view."""
    from_home = ", from home" if field.name == _POSTURE else ""
    units = " and ".join(f"{unit:g}" for unit in field.concise)
    return Field(
        field.name,
        field.size * len(field.concise),
        -1.0,
        1.0,
        f"{field.unit} in {units}",
        f"{field.description}{from_home}",
        field.mujoco,
    )


def _range(part: slice) -> str:
    return f"{part.start}" if part.stop == part.start + 1 else f"{part.start}-{part.stop - 1}"


def arm_values(state: CellState, commanded_q_rad: Array) -> dict[str, Array]:
    """Return the values of `ARM_FIELDS`."""
    return {
        "q_rad": state.q_rad,
        "qd_rad_s": state.qd_rad_s,
        "commanded_q_rad": commanded_q_rad,
        "flange_base_m": state.flange_base_m,
        "flange_base_quat": state.flange_base_quat,
    }


def wrench_values(wrench: Array) -> dict[str, Array]:
    """Return the values of `wrench_fields` from wrenches, (n, 2, 6)."""
    return {"force_n": wrench[..., :3], "torque_nm": wrench[..., 3:]}


def per_arm(values: Array) -> Array:
    """Repeat values, (n,), for both arms, (n, 2, 1)."""
    return values.repeat(2).reshape(-1, 2, 1)


def pose_of(fields: Mapping[str, Array], name: str) -> Poses:
    """Return the pose in the fields `<name>_m` and `<name>_quat`."""
    return Poses(fields[f"{name}_m"], fields[f"{name}_quat"])


def pose_values(name: str, pose: Array) -> dict[str, Array]:
    """Return the values of the fields `<name>_m` and `<name>_quat` from positions and quaternions, (n, 2, 7)."""
    return {f"{name}_m": pose[..., :3], f"{name}_quat": pose[..., 3:]}


def pose_fields(
    name: str, thing: str, mujoco: str = "-", bound_m: float = 10.0, *, concise: bool = False
) -> tuple[Field, Field]:
    """Return the fields `<name>_m` and `<name>_quat` of the pose of a thing, in the concise view or not."""
    near, turn = _NEAR_POSE if concise else ((), ())
    return (
        Field(f"{name}_m", 3, -bound_m, bound_m, "position (m)", f"position of {thing}", mujoco, near),
        Field(f"{name}_quat", 4, -1.01, 1.01, "quaternion", f"orientation of {thing}", mujoco, turn),
    )


_NEAR_POSE: Final = (0.2,), (0.5,)  # units of the concise view, m and of a quaternion


_JOINTS: Final = "{arm}/shoulder_pan_joint ... {arm}/wrist_3_joint"

ARM_FIELDS: Final = (
    Field("q_rad", 6, -6.5, 6.5, "angle (rad)", "joint positions", _JOINTS),
    Field("qd_rad_s", 6, -10.0, 10.0, "speed (rad/s)", "joint speeds", _JOINTS),
    Field(_POSTURE, 6, -6.5, 6.5, "angle (rad)", "commanded joint positions", _JOINTS),
    *pose_fields("flange_base", "the flange", "{arm}/flange", 2.0),
)
"""First fields of every task."""

OTHER_FLANGE_FIELDS: Final = pose_fields(
    "other_flange", "the other flange in the frame of this one", "{other}/flange", 5.0
)
"""Pose of the other arm's flange in this arm's flange frame."""


def gripper_field(arm: str = "arm") -> Field:
    """Return the field of the gripper's width: of this "arm", or of the "other" one."""
    name, thing = ("gripper_m", "the gripper") if arm == "arm" else ("other_gripper_m", "the other gripper")
    joints = f"{{{arm}}}/finger_1_joint ... {{{arm}}}/finger_2_joint"
    return Field(name, 1, -0.1, 0.1, "position (m)", f"opening of {thing}", joints)


def wrench_fields(thing: str) -> tuple[Field, Field]:
    """Return the fields of the force and torque that a thing exerts on the gripper."""
    return (
        Field("force_n", 3, -2000.0, 2000.0, "force (N)", f"force of the {thing} on the gripper", "{arm}/wrench"),
        Field(
            "torque_nm",
            3,
            -2000.0,
            2000.0,
            "torque (N·m)",
            f"torque of the {thing} on the gripper about the flange",
            "{arm}/wrench",
        ),
    )
