"""Scripted policy for Handover."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import ClassVar, Final

import numpy as np

from dual_ur10.assets.props import BLOCK_SIZE_M
from dual_ur10.assets.settings import DEFAULT_TOOLS
from dual_ur10.envs.tasks.geometry import LEARNERS_ROOM_M
from dual_ur10.envs.tasks.handover.goals import WIDTH_M
from dual_ur10.envs.tasks.handover.settings import HandoverSettings
from dual_ur10.envs.tasks.handover.task import Handover
from dual_ur10.envs.tasks.observation_layout import pose_of
from dual_ur10.envs.tasks.task import Timing, duration_ratio
from dual_ur10.errors import LostError
from dual_ur10.policies.scripted.base import ScriptedPolicy, on_table
from dual_ur10.policies.scripted.free_motion import FreeMotion
from dual_ur10.policies.scripted.handover_paths import HandoverPaths
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import rotate
from ur_core.tools.tool import Tool, strokes_m
from ur_core.types import Array, Rows

Fields = Mapping[str, Array]
"""Fields of one row's observation, (2, field size) each."""

_SPEED_RATIO: Final = 0.92  # of the task's limit
_FOLLOWED_RAD: Final = 0.01  # largest lag of the command behind the goal at which the motion goes on
_DT_S: Final = 0.01
_CLOSED_M: Final = 0.004  # from the block's width: closer fingers hold it
_OPEN_M: Final = 0.02  # from the block's width: fingers that are so much wider are off it, or half their stroke beyond
_EMPTY_M: Final = 0.01  # below the block's width: nothing is between the fingers
_LAID_M: Final = 0.01  # above its place on the table: a block that is let go there lands well
_SURE_S: Final = 0.1  # for which the fingers must be in place
_PATIENCE_S: Final = 2.0  # after which the next motion begins anyway

# Of an expert, that follows a learner along the path.
_ASIDE_RAD: Final = 0.02  # distance from the path at which the motion waits for the learner
_SLOW_RAD_S: Final = 0.1  # speed along the path below which time locates the learner better than position
_BACK_PERIODS: Final = 3.0  # largest shift back or forward at each step
_OFF_RAD: Final = 3e-3  # distance from its beginning with which a motion starts
_THERE_RAD: Final = 4e-3  # distance from its end at which it is over

_PICK, _MEET, _GIVE, _PLACE, _LEAVE = range(5)


@dataclasses.dataclass
class _Episode:
    """State of one row.

    Attributes:
        giver: Index of the giver.
        phase: One of the five phases above.
        motion: Motion of the phase; None: none.
        goal_rad: (12,) last commanded positions.
        time_s: Time in the motion, or since its end.
        waited_s: Time since the gripper was commanded.
        sure_s: Time since its fingers are in place.
        gripper: (2,) commands of the grippers.
    """

    giver: int
    phase: int
    motion: FreeMotion | None
    goal_rad: Array
    time_s: float = 0.0
    waited_s: float = 0.0
    sure_s: float = 0.0
    gripper: Array = dataclasses.field(default_factory=lambda: np.ones(2))


class HandoverPolicy(ScriptedPolicy):
    """Picks up the block, hands it over and places it.

    Each motion is planned from the observation at its beginning. Between motions the policy waits for the fingers. The
    settings of the task have no effect.
    """

    task: ClassVar[type[Handover]] = Handover

    def __init__(
        self,
        timing: Timing,
        action_mode: str = "joint_delta",
        mounts: Sequence[ArmMount] | None = None,
        limits: MotionLimits | None = None,
        settings: HandoverSettings | None = None,
        tools: tuple[Tool, Tool] = DEFAULT_TOOLS,
    ) -> None:
        super().__init__(timing, action_mode, mounts, limits, settings, tools)
        calm = np.tile(Handover.limits.speed_rad_s, 2) / duration_ratio(Handover.limits, self.limits)
        self._speed = np.minimum(np.tile(self.limits.speed_rad_s, 2), calm) * _SPEED_RATIO
        self._paths = HandoverPaths(self.mounts, self._speed, timing.period_s, levers_m=self._levers_m)
        beyond_m = (np.array(strokes_m(tools)) - WIDTH_M) / 2
        self._open_m = WIDTH_M + np.minimum(_OPEN_M, beyond_m)
        self._is_expert = False
        self.reset()

    def teach(self) -> None:
        """Grip higher, because a less exact learner needs more room above the table; see `Teaching`.

        A learner does not know the time in a motion either. An expert answers how to go on from where the arms are.
        """
        self._paths = HandoverPaths(self.mounts, self._speed, self.timing.period_s, LEARNERS_ROOM_M, self._levers_m)
        self._is_expert = True

    def reset(self) -> None:
        """Forget everything: an episode begins."""
        self._clock: Array | None = None
        self._episodes: list[_Episode] = []

    def begin(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Begin episodes in some rows of the batch; see `dual_ur10.policies.policy.EpisodeAware`."""
        if self._clock is not None:
            self._clock[rows] = np.inf

    def __call__(self, observation: Array) -> Array:
        """Return the float32 action for an observation, or one for each row of a batch of observations.

        Raises:
            ActionError: Not an observation of Handover.
            UnreachableError: The block or its target cannot be reached.
        """
        batch = self.batch(observation, None if self._clock is None else len(self._clock))
        arms, n = [self.layout.split(row) for row in batch], len(batch)
        if self._clock is None:
            self._clock, self._episodes = np.full(n, np.inf), [_new(row) for row in arms]
        clock = self.layout.split(batch)["progress"][:, 0, 0]
        for row in np.flatnonzero(clock < self._clock).tolist():
            self._episodes[row] = self._begun(arms[row])
        self._clock = clock.copy()
        actions = [self._act(episode, row) for episode, row in zip(self._episodes, arms, strict=True)]
        return np.array(actions).reshape(*np.shape(observation)[:-1], -1).astype(np.float32)

    def _begun(self, arms: Fields) -> _Episode:
        episode = _new(arms)
        block = self._paths.to_cell(on_table(pose_of(arms, "block_base"), self.mounts, BLOCK_SIZE_M[2] / 2))
        episode.motion = self._paths.pick(arms["commanded_q_rad"], episode.giver, _of(block, episode.giver))
        return episode

    def _act(self, episode: _Episode, arms: Fields) -> Array:
        """Return the action of one row, (14,)."""
        commanded = arms["commanded_q_rad"].reshape(12)
        if self._is_expert and episode.motion is not None:
            self._check_block(episode, arms)
            self._follow(episode, episode.motion, commanded)
        elif np.abs(commanded - episode.goal_rad).max() < _FOLLOWED_RAD:
            episode.time_s += self.timing.period_s
        if self._is_over(episode, commanded):
            self._handle(episode, arms)
        if episode.motion is not None:
            episode.goal_rad = episode.motion.at(episode.time_s)
        joints = self.action(episode.goal_rad, commanded).reshape(2, 6)
        return np.concatenate([joints, episode.gripper[:, None]], axis=1).reshape(-1)

    def _is_over(self, episode: _Episode, commanded: Array) -> bool:
        motion = episode.motion
        if motion is None or episode.time_s > motion.duration_s:
            return True
        return self._is_expert and bool(np.abs(commanded - motion.at(motion.duration_s)).max() < _THERE_RAD)

    def _check_block(self, episode: _Episode, arms: Fields) -> None:
        """Go on if a learner has let the block go on the table; elsewhere the block is lost.

        Otherwise the expert would answer to lower and close an empty gripper, and in another episode, for the same
        observation, to open it and draw it back.

        Raises:
            LostError: The block has left the gripper that should carry it.
        """
        if episode.phase not in (_MEET, _PLACE):
            return
        receiver = 1 - episode.giver
        arm = episode.giver if episode.phase == _MEET else receiver
        if WIDTH_M - _EMPTY_M < arms["gripper_m"][arm, 0] < self._open_m[arm]:
            return
        block = self._paths.to_cell(pose_of(arms, "block_base"))
        if episode.phase == _MEET or block.position_m[arm, 2] > BLOCK_SIZE_M[2] / 2 + _LAID_M:
            raise LostError("the block has left the gripper that should carry it")
        episode.gripper[receiver] = 1.0
        self._go_on(episode, arms)

    def _go_on(self, episode: _Episode, arms: Fields) -> None:
        """Begin the next phase."""
        episode.phase += 1
        episode.time_s = episode.waited_s = episode.sure_s = 0.0
        episode.motion = self._next(episode, arms)

    def _follow(self, episode: _Episode, motion: FreeMotion, commanded: Array) -> None:
        """Go on from the learner's place on the path, the more slowly the farther it is from the path.

        So the answer depends on where the learner has led the arms, not on a time that it does not know. Where the
        motion is slow, places reveal little and time goes on by itself: the slowest part, from rest, is skipped, and
        near its end the motion is over.
        """
        ahead, here = motion.at(episode.time_s + _DT_S), motion.at(episode.time_s)
        speed, off = (ahead - here) / _DT_S, commanded - here
        shift = float(off @ speed / (speed @ speed + _SLOW_RAD_S**2))
        shift = min(max(shift, -_BACK_PERIODS * self.timing.period_s), _BACK_PERIODS * self.timing.period_s)
        aside = float(np.abs(off - shift * speed).max())
        forward = self.timing.period_s * max(0.0, 1.0 - aside / _ASIDE_RAD)
        episode.time_s = max(0.0, episode.time_s + shift) + forward
        while (
            episode.time_s < motion.duration_s and np.abs(motion.at(episode.time_s) - motion.at(0.0)).max() < _OFF_RAD
        ):
            episode.time_s += self.timing.period_s / 4

    def _handle(self, episode: _Episode, arms: Fields) -> None:
        """Close or open a gripper, and begin the next motion once its fingers are in place."""
        if episode.phase == _LEAVE:
            return
        opens = episode.phase in (_GIVE, _PLACE)
        arm = episode.giver if episode.phase in (_PICK, _GIVE) else 1 - episode.giver
        episode.gripper[arm] = 1.0 if opens else -1.0
        width = arms["gripper_m"][arm, 0]
        done = width > self._open_m[arm] if opens else abs(width - WIDTH_M) < _CLOSED_M
        episode.waited_s += self.timing.period_s
        episode.sure_s = episode.sure_s + self.timing.period_s if done else 0.0
        if episode.sure_s > _SURE_S or episode.waited_s > _PATIENCE_S:
            self._go_on(episode, arms)

    def _next(self, episode: _Episode, arms: Fields) -> FreeMotion | None:
        """Return the motion of the phase that begins."""
        paths, giver, receiver = self._paths, episode.giver, 1 - episode.giver
        q = arms["commanded_q_rad"]
        flange = paths.to_cell(pose_of(arms, "flange_base"))
        tools = Poses(flange.position_m + rotate(flange.quat, self._levers_m), flange.quat)
        if episode.phase == _MEET:
            return paths.meet(q, giver, _of(tools, giver))
        if episode.phase == _PLACE:
            block, target = (
                _of(paths.to_cell(pose_of(arms, name)), receiver) for name in ("block_base", "target_base")
            )
            return paths.place(q, giver, tools, block, target)
        return paths.leave(q, giver, _of(tools, receiver)) if episode.phase == _LEAVE else None


def _new(arms: Fields) -> _Episode:
    return _Episode(0 if arms["role"][0, 0] > 0 else 1, _PICK, None, arms["commanded_q_rad"].reshape(12).copy())


def _of(poses: Poses, arm: int) -> Poses:
    return Poses(poses.position_m[arm], poses.quat[arm])
