"""Scripted policy for Handover."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from dual_ur10.assets.props import BLOCK_SIZE_M
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.envs.tasks.handover.settings import HandoverSettings
from dual_ur10.envs.tasks.handover.stages import WIDTH_M
from dual_ur10.envs.tasks.handover.task import Handover
from dual_ur10.envs.tasks.holding import TCP_LEVER
from dual_ur10.envs.tasks.observation_layout import pose_of
from dual_ur10.envs.tasks.task import Timing, slower
from dual_ur10.errors import ActionError, LostError, SettingsError
from dual_ur10.kinematics.frames import ArmMount
from dual_ur10.kinematics.poses import Poses
from dual_ur10.kinematics.rotations import rotate
from dual_ur10.policies.scripted.carrying import TAUGHT_HIGHER_M, lying
from dual_ur10.policies.scripted.free_motion import FreeMotion
from dual_ur10.policies.scripted.handover_paths import Ways
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.types import Array, Rows

Fields = Mapping[str, Array]
"""Fields of one row's observation, (2, field size) each."""

_SPEED_SHARE: Final = 0.92  # of the task's limit
_FOLLOWED_RAD: Final = 0.01  # how far a command may be behind what was wanted, before the motion waits for it
_ASIDE_RAD: Final = 0.02  # how far beside the way a pupil may be, before the motion waits for it
_SLOW_RAD_S: Final = 0.1  # speed along the way below which time says more about where it is than the place
_BACK_PERIODS: Final = 3.0  # by which a pupil may be behind or ahead, at each step
_OFF_RAD: Final = 3e-3  # from where a pupil's motion begins, with the first step
_THERE_RAD: Final = 4e-3  # to where it ends, when it is over
_DT_S: Final = 0.01
_CLOSED_M: Final = 0.004  # of the block's width: fingers that are so near it hold
_OPEN_M: Final = 0.06  # opening at which fingers are off the block
_EMPTY_M: Final = 0.01  # less opening than the block's width: nothing is between the fingers
_LAID_M: Final = 0.01  # above where it lies: what is let go there lands well
_SURE_S: Final = 0.1  # how long it must look so
_PATIENCE_S: Final = 2.0  # after which the next motion begins even so

_PICK, _MEET, _GIVE, _PLACE, _LEAVE = range(5)


@dataclasses.dataclass
class _Episode:
    """What one row does.

    Attributes:
        giver: Index of the giver.
        phase: What it is at.
        motion: Its motion; None: none.
        time_s: Time in that motion, or since its end.
        waited_s: Time since the gripper was told, and for how long it has looked done.
        opening: (2,) commands of the grippers.
        goal_rad: (12,) what was commanded last.
    """

    giver: int
    phase: int
    motion: FreeMotion | None
    goal_rad: Array
    time_s: float = 0.0
    waited_s: float = 0.0
    sure_s: float = 0.0
    opening: Array = dataclasses.field(default_factory=lambda: np.ones(2))


class HandoverPolicy:
    """Picks the block up, hands it over and lays it down, as observed when each motion begins.

    Motions are planned; between them it waits until the fingers are where they should be.

    Args:
        timing: Rate and latency of actions.
        action_mode: "joint_delta" or "joint_position".
        mounts: Where the arms stand, and their kinematics.
        limits: What the arms may do, as the cell allows it.
        settings: Those of the task; they do not matter to it.
    """

    def __init__(
        self,
        timing: Timing,
        action_mode: str,
        mounts: Sequence[ArmMount] | None = None,
        limits: MotionLimits | None = None,
        settings: HandoverSettings | None = None,
    ) -> None:
        if action_mode not in ("joint_delta", "joint_position"):
            raise SettingsError(f"the scripted policy commands joints: action_mode {action_mode!r} is not for it")
        self.timing, self.action_mode = timing, action_mode
        self.mounts = SceneSettings().mounts if mounts is None else tuple(mounts)
        allowed = limits or Handover.limits
        speed = np.tile(allowed.speed_rad_s, 2)
        self._step = speed * timing.period_s
        calm = np.tile(Handover.limits.speed_rad_s, 2) / slower(Handover.limits, allowed)
        self._speed = np.minimum(speed, calm) * _SPEED_SHARE
        self._ways = Ways(self.mounts, self._speed, timing.period_s)
        self._teaches = False
        self.reset()

    def teach(self) -> None:
        """See `dual_ur10.policies.policy.Teaching`: a pupil who is not so exact needs more room above the table.

        Nor does it know the time in a motion: it is told how to go on from where it is.
        """
        self._ways = Ways(self.mounts, self._speed, self.timing.period_s, TAUGHT_HIGHER_M)
        self._teaches = True

    def reset(self) -> None:
        """Forget everything: an episode begins."""
        self._clock: Array | None = None
        self._episodes: list[_Episode] = []

    def begin(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Rows of the batch begin episodes; see `dual_ur10.policies.evaluation.evaluate.EpisodeAware`."""
        if self._clock is not None:
            self._clock[rows] = np.inf

    def __call__(self, observation: Array) -> Array:
        """Action of float32 for an observation, or one for each row of a batch of observations.

        Raises:
            ActionError: Not an observation of Handover.
            UnreachableError: The block or its target cannot be reached.
        """
        batch = Handover.layout.batch(observation, Handover.name)
        arms, n = [Handover.layout.split(row) for row in batch], len(batch)
        if self._clock is None:
            self._clock, self._episodes = np.full(n, np.inf), [_new(row) for row in arms]
        if len(self._clock) != n:
            raise ActionError(f"{n} observations after {len(self._clock)}: call reset() before another number")
        clock = Handover.layout.split(batch)["progress"][:, 0, 0]
        for row in np.flatnonzero(clock < self._clock).tolist():
            self._episodes[row] = self._begun(arms[row])
        self._clock = clock.copy()
        actions = [self._act(episode, row) for episode, row in zip(self._episodes, arms, strict=True)]
        return np.array(actions).reshape(*np.shape(observation)[:-1], -1).astype(np.float32)

    def _begun(self, arms: Fields) -> _Episode:
        episode = _new(arms)
        block = self._ways.to_cell(lying(pose_of(arms, "block_base"), self.mounts, BLOCK_SIZE_M[2] / 2))
        episode.motion = self._ways.pick(arms["commanded_q_rad"], episode.giver, _of(block, episode.giver))
        return episode

    def _act(self, episode: _Episode, arms: Fields) -> Array:
        """Action of one row, (14,)."""
        commanded = arms["commanded_q_rad"].reshape(12)
        if self._teaches and episode.motion is not None:
            self._see_to_block(episode, arms)
            self._follow(episode, episode.motion, commanded)
        elif np.abs(commanded - episode.goal_rad).max() < _FOLLOWED_RAD:
            episode.time_s += self.timing.period_s
        if self._is_over(episode, commanded):
            self._handle(episode, arms)
        if episode.motion is not None:
            episode.goal_rad = episode.motion.at(episode.time_s)
        goal = episode.goal_rad if self.action_mode == "joint_position" else (episode.goal_rad - commanded) / self._step
        return np.concatenate([goal.reshape(2, 6), episode.opening[:, None]], axis=1).reshape(-1)

    def _is_over(self, episode: _Episode, commanded: Array) -> bool:
        motion = episode.motion
        if motion is None or episode.time_s > motion.duration_s:
            return True
        return self._teaches and bool(np.abs(commanded - motion.at(motion.duration_s)).max() < _THERE_RAD)

    def _see_to_block(self, episode: _Episode, arms: Fields) -> None:
        """What a pupil has let go on the table is laid; elsewhere it is lost.

        Without this it would be told to lower and to close an empty hand, and elsewhere, with just the same before its
        eyes, to open it and to draw it back.

        Raises:
            LostError: The block has left the hand that should carry it.
        """
        if episode.phase not in (_MEET, _PLACE):
            return
        receiver = 1 - episode.giver
        arm = episode.giver if episode.phase == _MEET else receiver
        if WIDTH_M - _EMPTY_M < arms["gripper_m"][arm, 0] < _OPEN_M:
            return
        block = self._ways.to_cell(pose_of(arms, "block_base"))
        if episode.phase == _MEET or block.position_m[arm, 2] > BLOCK_SIZE_M[2] / 2 + _LAID_M:
            raise LostError("the block has left the hand that should carry it")
        episode.opening[receiver] = 1.0
        self._go_on(episode, arms)

    def _go_on(self, episode: _Episode, arms: Fields) -> None:
        """Begin the next phase."""
        episode.phase += 1
        episode.time_s = episode.waited_s = episode.sure_s = 0.0
        episode.motion = self._next(episode, arms)

    def _follow(self, episode: _Episode, motion: FreeMotion, commanded: Array) -> None:
        """Go on from where on the way the pupil is, and the more slowly the farther off it.

        So what it is told depends on where it has led the arms, not on a time that it does not know. Where the motion
        is slow places tell little, and time goes on by itself: the slowest part, from rest, is left out, and near the
        end it is over.
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
        """Close or open the fingers that are to, and begin the next motion once they are where they should be."""
        if episode.phase == _LEAVE:
            return
        opens = episode.phase in (_GIVE, _PLACE)
        arm = episode.giver if episode.phase in (_PICK, _GIVE) else 1 - episode.giver
        episode.opening[arm] = 1.0 if opens else -1.0
        opening = arms["gripper_m"][arm, 0]
        done = opening > _OPEN_M if opens else abs(opening - WIDTH_M) < _CLOSED_M
        episode.waited_s += self.timing.period_s
        episode.sure_s = episode.sure_s + self.timing.period_s if done else 0.0
        if episode.sure_s > _SURE_S or episode.waited_s > _PATIENCE_S:
            self._go_on(episode, arms)

    def _next(self, episode: _Episode, arms: Fields) -> FreeMotion | None:
        """The motion of the phase that begins."""
        ways, giver, receiver = self._ways, episode.giver, 1 - episode.giver
        q = arms["commanded_q_rad"]
        flange = ways.to_cell(pose_of(arms, "flange_base"))
        tools = Poses(flange.position_m + rotate(flange.quat, np.tile(TCP_LEVER, (2, 1))), flange.quat)
        if episode.phase == _MEET:
            return ways.meet(q, giver, _of(tools, giver))
        if episode.phase == _PLACE:
            block, target = (_of(ways.to_cell(pose_of(arms, name)), receiver) for name in ("block_base", "target_base"))
            return ways.place(q, giver, tools, block, target)
        return ways.leave(q, giver, _of(tools, receiver)) if episode.phase == _LEAVE else None


def _new(arms: Fields) -> _Episode:
    return _Episode(0 if arms["role"][0, 0] > 0 else 1, _PICK, None, arms["commanded_q_rad"].reshape(12).copy())


def _of(poses: Poses, arm: int) -> Poses:
    return Poses(poses.position_m[arm], poses.quat[arm])
