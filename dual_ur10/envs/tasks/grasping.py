"""Base of staged tasks whose arms grip props: measurement of the grasps, observations and starts at home."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Generic, NamedTuple

import numpy as np

from dual_ur10.envs.tasks.geometry import Grasped, Grasps, required
from dual_ur10.envs.tasks.observation_layout import (
    ARM_FIELDS,
    ObservationLayout,
    arm_values,
    gripper_field,
    pose_fields,
    pose_values,
    wrench_fields,
    wrench_values,
)
from dual_ur10.envs.tasks.staged import NowT, StagedTask
from dual_ur10.envs.tasks.task import SettingsT, Timing
from dual_ur10.errors import SettingsError
from dual_ur10.kinematics.frames import Frames
from dual_ur10.kinematics.poses import Poses
from dual_ur10.sim2real.config.cell import CellConfig, CellState, Start
from dual_ur10.types import Array, Rows


class Grip(NamedTuple):
    """Place where an arm grips a prop.

    Attributes:
        prop: Name of the prop.
        tool: Pose of the tool in the frame of the prop, (3,) and (4,).
        width_m: Width of the prop between the fingers.
    """

    prop: str
    tool: Poses
    width_m: float


class GraspingTask(StagedTask[SettingsT, Grasped, NowT], Generic[SettingsT, NowT]):
    """Staged task in which each arm grips a prop, both the same one or each its own.

    It measures with `Grasps`, so that `facts` gets a `Grasped`. The observation of an arm has the fields of every task,
    the width of its gripper, the wrench of the object on it, and the pose of each observed prop in its own `base`
    frame, in the fields `<prop>_base_m` and `<prop>_base_quat`. The settings have a `duration_s`.

    Attributes:
        grips: Grips of the left and the right arm.
        observed: Names of the props in the observation, those of the grips among them.

    Raises:
        SettingsError: The prop of a grip is not observed.
    """

    grips: ClassVar[tuple[Grip, Grip]]
    observed: ClassVar[tuple[str, ...]]

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Make the layout from the observed props, unless the class states one."""
        super().__init_subclass__(**keywords)
        if "observed" in vars(cls) and "layout" not in vars(cls):
            poses = [field for name in cls.observed for field in pose_fields(f"{name}_base", f"the {name}")]
            cls.layout = ObservationLayout(*ARM_FIELDS, gripper_field(), *wrench_fields("object"), *poses)

    def __init__(self, settings: SettingsT, cell: CellConfig, timing: Timing, n: int) -> None:
        super().__init__(settings, cell, timing, n, settings.duration_s)  # type: ignore[attr-defined]
        left, right = self.grips
        if missing := {left.prop, right.prop} - {*self.observed}:
            raise SettingsError(
                f"{type(self).__name__} grips {', '.join(sorted(missing))}, but observes {', '.join(self.observed)}: "
                "name the props of all grips in `observed`"
            )
        self._grasps = Grasps(
            Frames((cell.left, cell.right)),
            np.tile(np.stack([left.tool.position_m, right.tool.position_m]), (n, 1, 1)),
            (left.width_m, right.width_m),
            len(self.observed),
            (self.observed.index(left.prop), self.observed.index(right.prop)),
            cell.equipment.tools,
        )

    def start_at_home(self, rows: Rows, objects: Mapping[str, Array]) -> Start:
        """Begin episodes in `rows` with both arms at home and open grippers, and return their starts.

        Args:
            rows: The rows of `start`.
            objects: Poses of props, as in `Start`.
        """
        self.begin_rows(rows)
        return self.at_home(rows)._replace(objects=objects)

    def measure(self, state: CellState) -> Grasped:
        """Measure both grasps, and the observed props."""
        poses = np.concatenate([part for name in self.observed for part in state.objects[name]], axis=1)
        flanges = Poses(state.flange_m, required(state.flange_quat))
        return self._grasps(flanges, required(state.gripper_m), poses.reshape(self.n, -1, 7))

    def observe(self, state: CellState, measured: Grasped, commanded_q_rad: Array) -> Array:
        """Assemble the observations in the order of the layout."""
        values = {**arm_values(state, commanded_q_rad), **wrench_values(required(state.wrench))}
        values["gripper_m"] = required(state.gripper_m)[..., None]
        for k, name in enumerate(self.observed):
            values |= pose_values(f"{name}_base", measured.in_bases[:, :, k])
        return self.layout.join(values)
