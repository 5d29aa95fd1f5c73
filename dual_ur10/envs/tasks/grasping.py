"""Base of staged tasks whose arms grip props: measurement of the grasps, observations and starts at home.

Observations lead each tool to its grip; the base knows no later goals of the task.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Generic, NamedTuple

import numpy as np

from dual_ur10.assets.prop_part import PropPart
from dual_ur10.envs.tasks.description import described
from dual_ur10.envs.tasks.geometry import KEEP, Goal, GoalSteps, frame_of, required
from dual_ur10.envs.tasks.goal_fields import GOAL_FIELDS, goal_values, gripper_values
from dual_ur10.envs.tasks.grasps import Grasped, Grasps
from dual_ur10.envs.tasks.observation_layout import (
    ARM_FIELDS,
    Field,
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
from dual_ur10.sim2real.cell.cell import CellState, Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses
from ur_core.tools.tool import strokes_m
from ur_core.types import Array, Mask, Rows

SLOW = 0.04
"""Step of the opening, of the largest, that the goals of slow fingers show."""


class Grip(NamedTuple):
    """Place where an arm grips a prop.

    Attributes:
        prop: Name of the prop.
        tool: Pose of the tool in the frame of the prop, or of its body, (3,) and (4,). The tool's z points out of the
            gripper, and its fingers close along its y; (0, 0, 1, 0) and (0, 1, 0, 0) point it downwards.
        width_m: Width of the prop between the fingers.
        body: Name of a body of the prop that its joints move, such as a lid; "": the prop itself.
    """

    prop: str
    tool: Poses
    width_m: float
    body: str = ""


class Lead(NamedTuple):
    """Goals of both arms beyond their grips.

    Attributes:
        tools: (n, 2, 12) frames of the tools, as `dual_ur10.envs.tasks.geometry.frame_of` returns them, in that of the
            cell; `GraspingTask.bringing` makes them of poses of the objects.
        closed: (n, 2) True for a gripper that is to be closed.
    """

    tools: Array
    closed: Mask


class GraspingTask(StagedTask[SettingsT, Grasped, NowT], Generic[SettingsT, NowT]):
    """Staged task in which each arm grips a prop, both the same one or each its own.

    It measures with `Grasps`, so that `facts` gets a `Grasped`, whose frames are those of the observed props, then
    those of bodies that are gripped. The observation of an arm has the fields of every task, the width of its gripper,
    the wrench of the object on it, the pose of each observed prop in its own `base` frame, in the fields
    `<prop>_base_m` and `<prop>_base_quat`, the fields of `further`, and those that lead its tool to its grip,
    `dual_ur10.envs.tasks.goal_fields.GOAL_FIELDS`. Its goal of the gripper is near the present opening while fingers
    touch or leave an object: at full speed one of them strikes it. `observation="goals"` shows the poses, and what
    leads to the grips. The settings have a `duration_s`. In the docstring of a subclass, lines that hold `{actions}`,
    `{observations}` or `{arguments}` alone become these tables.

    Attributes:
        grips: Grips of the left and the right arm.
        observed: Names of the props in the observation, those of grips without a `body` among them.
        further: Further fields of an observation, with the values of `further_values`.
        frames: Frames of the cell and of both bases.
        elapsed_s: (n,) time from the last observation of a row to this one, for `lead` and `further_values`; 0 in the
            first of an episode, and where the same state is observed again.

    Raises:
        SettingsError: The prop of a grip is not observed, or not in the scene.
        UnknownNameError: A prop has no such body.
    """

    grips: ClassVar[tuple[Grip, Grip]]
    observed: ClassVar[tuple[str, ...]]
    further: ClassVar[tuple[Field, ...]] = ()

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Make the layout from the observed props, unless the class states one, and the tables of the docstring."""
        super().__init_subclass__(**keywords)
        if "observed" in vars(cls) and "layout" not in vars(cls):
            poses = [
                field for name in cls.observed for field in pose_fields(f"{name}_base", f"the {name}", concise=True)
            ]
            known = *ARM_FIELDS, gripper_field(), *wrench_fields("object"), *poses, *cls.further
            cls.layout = ObservationLayout(*known, *GOAL_FIELDS)
        if vars(cls).get("__doc__") and hasattr(cls, "settings_type"):
            cls.__doc__ = described(cls.__doc__ or "", cls)

    def __init__(self, settings: SettingsT, cell: CellConfig, timing: Timing, n: int) -> None:
        super().__init__(settings, cell, timing, n, settings.duration_s)  # type: ignore[attr-defined]
        left, right = self.grips
        if missing := {grip.prop for grip in self.grips if not grip.body} - {*self.observed}:
            raise SettingsError(
                f"{type(self).__name__} grips {', '.join(sorted(missing))}, but observes {', '.join(self.observed)}: "
                "name the props of all grips in `observed`"
            )
        mounts, tools = (cell.left, cell.right), cell.equipment.tools
        self._parts = [_part_of(grip, cell) for grip in self.grips if grip.body]
        parts = iter(range(len(self.observed), len(self.observed) + len(self._parts)))
        first, second = (next(parts) if grip.body else self.observed.index(grip.prop) for grip in self.grips)
        frames = len(self.observed) + len(self._parts)
        self.frames = Frames(mounts)
        self._grasps = Grasps(
            self.frames,
            np.tile(np.stack([left.tool.position_m, right.tool.position_m]), (n, 1, 1)),
            (left.width_m, right.width_m),
            frames,
            (first, second),
            tools,
        )
        self._strokes_m = np.array(strokes_m(tools))[:, None]
        self.elapsed_s, self._observed_s = np.zeros(n), np.zeros(n)
        self._held = [first, second]
        goals = [
            Goal(frame, grip.tool, approached=True) for frame, grip in zip((first, second), self.grips, strict=True)
        ]
        self._nearness = GoalSteps(n, frames, goals)
        self._to_grips: GoalSteps | None = None
        if any(field in self.layout.fields for field in GOAL_FIELDS):
            goals += [Goal(frames + arm) for arm in range(2)]
            self._to_grips = GoalSteps(n, frames + 2, goals, mounts, tcp_m=[tool.tcp_m for tool in tools])

    def start_at_home(self, rows: Rows, objects: Mapping[str, Array]) -> Start:
        """Begin episodes in `rows` with both arms at home and open grippers, and return their starts.

        Args:
            rows: The rows of `start`.
            objects: Poses of props, as in `Start`.
        """
        self.begin_rows(rows)
        self._observed_s[rows] = 0.0
        return self.at_home(rows)._replace(objects=objects)

    def measure(self, state: CellState) -> Grasped:
        """Measure both grasps, and the observed props."""
        found = [state.objects[name] for name in self.observed]
        found += [part(self.n, state.objects, state.joints) for part in self._parts]
        poses = np.concatenate([array for pose in found for array in pose], axis=1)
        flanges = Poses(state.flange_m, required(state.flange_quat))
        return self._grasps(flanges, required(state.gripper_m), poses.reshape(self.n, -1, 7))

    def observe(self, state: CellState, measured: Grasped, commanded_q_rad: Array) -> Array:
        """Assemble the observations in the order of the layout."""
        self.elapsed_s = np.maximum(state.time_s - self._observed_s, 0.0)
        self._observed_s = np.array(state.time_s)
        values = {**arm_values(state, commanded_q_rad), **wrench_values(required(state.wrench))}
        values["gripper_m"] = required(state.gripper_m)[..., None]
        for k, name in enumerate(self.observed):
            values |= pose_values(f"{name}_base", measured.in_bases[:, :, k])
        values |= self.further_values(state, measured)
        if self._to_grips is not None:
            lead = self.lead(state, measured)
            values |= self._goal_values(self._to_grips, measured, commanded_q_rad, values["gripper_m"], lead)
        return self.layout.join(values)

    def grasping(self, measured: Grasped) -> Array:
        """Return the progress of each arm towards holding its object, (n, 2), 0 to 1.

        Half of it is the nearness of the tool to its grip (`dual_ur10.envs.tasks.geometry.ToolSteps`), which has a
        slope at every distance and includes the rotation; of it closed fingers earn 0.8 until the grip is between them.
        Closing them there is 0.2, and holding 0.3.
        """
        near = self._nearness(measured.tools, measured.frames).nearness
        opened = np.where(measured.between, 1.0, 0.8 + 0.2 * measured.opened)
        progress: Array = 0.5 * near * opened + measured.between * 0.2 * measured.closed + 0.3 * measured.holding
        return progress

    def forces_n(self, state: CellState) -> Array:
        """Return the forces of the objects on both grippers, (n, 2, 3) in the cell frame."""
        return self.frames.vector_to_cell(required(state.wrench)[..., :3])

    def further_values(self, state: CellState, measured: Grasped) -> Mapping[str, Array]:
        """Return the values of the `further` fields, (n, 2, size) each."""
        return {}

    def lead(self, state: CellState, measured: Grasped) -> Lead | None:
        """Return the goals of both arms once the first stage is passed; None: these are the grips still.

        They are what the fields that lead a tool show, with the same poses as the observation has. It is called after
        `further_values`.
        """
        return None

    def bringing(self, measured: Grasped, objects: Poses) -> Array:
        """Return the frames of the tools, (n, 2, 12), that bring what they hold to poses, held as it is now.

        Args:
            measured: Both grasps.
            objects: Poses of each arm's object, or of its part, (n, 2, 3) and (n, 2, 4) in the cell frame.
        """
        tools, found, goals = measured.tools, measured.frames[:, self._held], frame_of(objects)
        (tool, begin, end) = (each[..., 3:].reshape(self.n, 2, 3, 3) for each in (tools, found, goals))
        turn = end @ begin.swapaxes(-1, -2)
        away_m = (turn @ (tools - found)[..., :3, None])[..., 0]
        return np.concatenate([goals[..., :3] + away_m, (turn @ tool).reshape(self.n, 2, 9)], axis=-1)

    def _goal_values(
        self, steps: GoalSteps, measured: Grasped, commanded_q_rad: Array, gripper_m: Array, lead: Lead | None
    ) -> dict[str, Array]:
        """Return the values of the fields that lead the commanded tools to their goals."""
        steps.actual[...] = measured.tools
        grips = np.ones((self.n, 2), dtype=bool) if lead is None else np.repeat(self.passed[:, None] == 0, 2, axis=1)
        goals = measured.tools if lead is None else lead.tools
        numbers = np.where(grips, [0, 1], [2, 3]).T
        found = steps(commanded_q_rad, np.concatenate([measured.frames, goals], axis=1), [*numbers])
        # Fingers close where the tool has arrived; those that have begun to go on at a larger error.
        within = np.where(measured.between & (measured.cleared < 1.0), KEEP, 1.0)
        closes = np.where(grips, measured.between & (found.away < within), False if lead is None else lead.closed)
        values = gripper_values(measured.between, closes, gripper_m, self._strokes_m)
        # Fingers touch an object slowly, and leave it slowly: at full speed one of them strikes it.
        opened = values["opening"][..., 0]
        slowly = measured.between & np.where(closes, ~measured.holding, measured.cleared < 1.0)
        ahead = (opened + np.where(closes, -SLOW, SLOW)).clip(0.0, 1.0)
        values["goal_opening"] = np.where(slowly, ahead, ~closes)[..., None]
        return {**goal_values(found, steps.nearby), **values}


def _part_of(grip: Grip, cell: CellConfig) -> PropPart:
    for prop in cell.equipment.props:
        if prop.name == grip.prop:
            return PropPart(prop, grip.body)
    raise SettingsError(f"a grip is of the prop {grip.prop!r}, and the scene has none of that name")
