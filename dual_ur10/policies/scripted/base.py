"""Common base of the scripted policies: checks of arguments and observations, inverse kinematics, and actions."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Generator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from dual_ur10.assets.settings import DEFAULT_TOOLS, SceneSettings
from dual_ur10.envs.tasks.task import Task, Timing
from dual_ur10.errors import ActionError, SettingsError
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics import nearest
from ur_core.kinematics.frames import ArmMount, Frames
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.tools.tool import Tool, levers_m
from ur_core.types import Array, Rows, changed


class ScriptedPolicy:
    """Policy that computes joint positions from observations.

    Args:
        timing: Rate and latency of actions.
        action_mode: "joint_delta" or "joint_position".
        mounts: Poses of the bases and kinematics of the arms; None: those of the default cell.
        limits: Motion limits of the task, as far as the cell allows them; None: those of the task.
        settings: Settings of the task; None: the default ones.
        tools: Tools of both arms.

    Attributes:
        layout: Fields of an observation.
        timing, mounts, limits, settings, tools: As given, or the defaults.

    Raises:
        SettingsError: Actions of this mode are not of joints.
    """

    task: ClassVar[type[Task[Any, Any]]]

    def __init__(
        self,
        timing: Timing,
        action_mode: str = "joint_delta",
        mounts: Sequence[ArmMount] | None = None,
        limits: MotionLimits | None = None,
        settings: Any = None,
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    ) -> None:
        if action_mode not in ("joint_delta", "joint_position"):
            raise SettingsError(f"the scripted policy commands joints: action_mode {action_mode!r} is not for it")
        self.timing, self.action_mode = timing, action_mode
        self.mounts = SceneSettings().mounts if mounts is None else tuple(mounts)
        self.limits = limits or self.task.limits
        self.tools, self._levers_m = tools, levers_m(tools)
        self.settings = self.task.settings_type() if settings is None else settings
        self.layout, self._name = self.task.layout_for(self.settings), self.task.__name__  # the name in messages
        self._step_rad = np.tile(self.limits.speed_rad_s, 2) * timing.period_s

    def __repr__(self) -> str:
        texts = (changed(self.settings), f"{self.action_mode} at {1.0 / self.timing.period_s:g} Hz")
        return f"{type(self).__name__}({', '.join(filter(None, texts))})"

    def batch(self, observation: Array, count: int | None) -> Array:
        """Return observations as a batch.

        Args:
            observation: One, or a batch.
            count: Number of observations of the call before; None: there was none since the reset.

        Raises:
            ActionError: The shape is not that of observations of the task, or their number has changed.
        """
        batch = self.layout.batch(observation, self._name)
        if count is not None and len(batch) != count:
            raise ActionError(f"{len(batch)} observations after {count}: call reset() before another number")
        return batch

    def action(self, goal_rad: Array, commanded_rad: Array) -> Array:
        """Return the action, (..., 12), that leads from the commanded to the goal positions."""
        return goal_rad if self.action_mode == "joint_position" else (goal_rad - commanded_rad) / self._step_rad

    def inverse(self, flanges: Poses, near_q_rad: Array) -> Array:
        """Return the joint positions nearest to others that put the flanges at poses in the arms' `base` frames.

        Args:
            flanges: (..., 2, 3) and (..., 2, 4).
            near_q_rad: (..., 2, 6).

        Raises:
            UnreachableError: A pose cannot be reached.
        """
        position, rotation = flanges.position_m, quat_to_matrix(flanges.quat)
        left, right = (mount.dh for mount in self.mounts)
        if left == right:
            # One call for arms with the same kinematics: it costs little more than for a single pose.
            return nearest(position, rotation, near_q_rad, left)
        arms = [
            nearest(position[..., k, :], rotation[..., k, :, :], near_q_rad[..., k, :], dh)
            for k, dh in enumerate((left, right))
        ]
        return np.stack(arms, axis=-2)


class Wish(NamedTuple):
    """Command of a `Script`.

    Attributes:
        q_rad: (2, 6) joint positions at the end of the next motion.
        opening: (2,) openings of the grippers, -1 closed to 1 open; None: there are none.
    """

    q_rad: Array
    opening: Array | None = None


Fields = Mapping[str, Array]
"""Fields of one row's observation, (2, field size) each."""


class Script(ScriptedPolicy):
    """Scripted policy that is written as one coroutine per episode; this base runs one for each row of a batch.

    A subclass names its `task` and writes `script`. An episode of a row begins with the first observation after `reset`
    or `begin`.
    """

    _scripts: list[Any] | None = None  # running coroutines; an ended one stays so
    _wishes: list[Wish | None]

    @abstractmethod
    def script(self, fields: Fields) -> Generator[Wish, Fields, None]:
        """Yield a wish for each observation of an episode; a `yield` returns the fields of the next observation.

        The last wish stays in force once the script has ended.

        Args:
            fields: Fields of the first observation; copies, which may be kept.
        """

    def reset(self) -> None:
        """Forget everything: an episode begins."""
        self._scripts = None

    def begin(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Begin episodes in some rows of the batch; see `dual_ur10.policies.policy.EpisodeAware`."""
        for row in rows if self._scripts is not None else ():
            self._wishes[row] = None

    def __call__(self, observation: Array) -> Array:
        """Return the float32 action for an observation, or one for each row of a batch of observations.

        Raises:
            ActionError: Not an observation of the task.
            SettingsError: A script ended before its first wish, or only some rows state openings.
        """
        batch = self.batch(observation, None if self._scripts is None else len(self._scripts))
        if self._scripts is None:
            self._scripts, self._wishes = [None] * len(batch), [None] * len(batch)
        actions = [self._act(row, self.layout.split(numbers.copy())) for row, numbers in enumerate(batch)]
        opened = [wish is not None and wish.opening is not None for wish in self._wishes]
        if any(opened) and not all(opened):
            self.reset()
            raise SettingsError(
                f"the script of {type(self).__name__} states openings in row {opened.index(True)} and none in row "
                f"{opened.index(False)}: state them in every Wish, or in none"
            )
        return np.array(actions).reshape(*np.shape(observation)[:-1], -1).astype(np.float32)

    def _act(self, row: int, fields: Fields) -> Array:
        """Return the action of one row."""
        scripts = self._scripts or []
        script, wish = scripts[row], self._wishes[row]
        try:
            if wish is None:
                script = scripts[row] = self.script(fields)
                wish = next(script)
            else:
                wish = script.send(fields)
        except StopIteration:
            if wish is None:
                raise SettingsError(f"the script of {type(self).__name__} ended before its first wish") from None
        except BaseException:
            self._wishes[row] = None  # another call begins anew, instead of repeating the last wish
            raise
        self._wishes[row] = wish
        joints = self.action(wish.q_rad.reshape(12), fields["commanded_q_rad"].reshape(12)).reshape(2, 6)
        return joints if wish.opening is None else np.concatenate([joints, wish.opening[:, None]], axis=1)


def on_table(pose: Poses, mounts: Sequence[ArmMount], height_m: float) -> Poses:
    """Correct measured poses, (..., 2, ...) in the arms' `base` frames, of an object that lies on the table.

    Args:
        pose: Measured, with errors.
        mounts: Of the arms.
        height_m: Height of the object's centre above the table.
    """
    if any(any(mount.tilt_rad) for mount in mounts):
        frames = Frames((mounts[0], mounts[1]))
        position, quat = frames.position_to_cell(pose.position_m), frames.quat_to_cell(pose.quat)
        position[..., 2], quat[..., 1:3] = height_m, 0.0
        quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
        return Poses(frames.position_to_base(position), frames.quat_to_base(quat))
    position, quat = pose.position_m.copy(), np.zeros_like(pose.quat)
    position[..., 2] = height_m - np.array([mount.position_m[2] for mount in mounts])
    quat[..., 0], quat[..., 3] = pose.quat[..., 0], pose.quat[..., 3]
    return Poses(position, quat / np.linalg.norm(quat, axis=-1, keepdims=True))
