"""Replay of a recorded episode: the same actions through the same adapter and gate."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.core.ends import early_end
from dual_ur10.envs.core.options import MOVE_TO_START
from dual_ur10.errors import DualUR10Error, RecordingError
from dual_ur10.sim2real.analysis.parity import bits_equal
from dual_ur10.sim2real.analysis.reconstruction import (
    check_replayable,
    check_same_actions,
    generator_of,
    generator_text,
    keywords_of,
    resets_of,
)
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.named_cell import resolve_cell
from dual_ur10.sim2real.recording.reader import file_of
from dual_ur10.sim2real.recording.run import Episode, Run
from dual_ur10.sim2real.recording.scan import open_regular
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.types import Array

_START_RAD: Final = 0.02  # largest distance of a start from that of the recording

AWAY_RAD: Final = 0.02
"""Largest difference of targets from the recorded ones on another cell: beyond it, the replay ends.

Joint steps accumulate. After a tighter limit or a stop, the same steps lead to other places, and to what stands there.
"""


def source_of(path: str | Path, episode: int) -> dict[str, Any]:
    """Return the source of a replay, as the keyword `record_about` of an environment takes it.

    Args:
        path: The recording that was read: its folder, or its file.
        episode: Number of the episode.

    Raises:
        RecordingError: It cannot be read.
    """
    file = file_of(path)
    opened, _ = open_regular(file)
    digest = hashlib.sha256()
    with opened:
        while piece := opened.read(2**20):
            digest.update(piece)
    run = file.resolve().parent.name
    return {"policy": f"replay of {run}", "replays": {"run": run, "sha256": digest.hexdigest(), "episode": episode}}


class RecordedPolicy:
    """Policy that returns the actions of a recorded episode one after the other, whatever the observation.

    Args:
        run: The recording.
        episode: Number of the episode in the order of the recording.

    Raises:
        RecordingError: There is no such episode, or it has no action.
    """

    def __init__(self, run: Run, episode: int = 0) -> None:
        self.episode = episode_of(run, episode)
        self._next = 0

    def __len__(self) -> int:
        return len(self.episode.action)

    def reset(self) -> None:
        """Start again with the first action."""
        self._next = 0

    def __call__(self, observation: Any) -> NDArray[Any]:
        """Return the next recorded action.

        Raises:
            RecordingError: There are no more.
        """
        if self._next >= len(self):
            raise RecordingError(
                f"the recorded episode has {len(self)} actions, and number {self._next} was asked for: end the episode "
                "there, or record a longer one"
            )
        action: NDArray[Any] = self.episode.action[self._next].copy()
        self._next += 1
        return action


@dataclass(frozen=True)
class Replay:
    """Result of a replay.

    Attributes:
        steps: Number of steps made.
        recorded: Number of steps recorded.
        targets_rad: (steps, ticks, 2, 6) targets that the gate released now.
        q_rad: (steps + 1, 2, 6) joints after the reset and after each step, now.
        flange_m: (steps + 1, 2, 3) flanges after the reset and after each step, now, in the cell frame.
        equal_targets: Number of ticks whose targets equal the recorded ones in every bit, for both arms.
        difference: First difference from the recording, in words; "": none. Targets are always compared, joints and
            rewards where a simulated run is simulated again.
        success: True if the task succeeded; None: the episode did not come to its end.
        ended_by: Reason of the end, such as the gate's verdict or a too large difference of the targets; "": none.
        late_actions: Number of actions that missed their deadline on two controllers, so that both arms stopped.
    """

    steps: int
    recorded: int
    targets_rad: Array
    q_rad: Array
    flange_m: Array
    equal_targets: int
    difference: str
    success: bool | None
    ended_by: str
    late_actions: int = 0

    @property
    def is_exact(self) -> bool:
        """True if the replay equals the recording."""
        return not self.difference


def episode_of(run: Run, number: int) -> Episode:
    """Return an episode that can be replayed.

    Raises:
        RecordingError: There is none of this number, or it has no action.
    """
    if not 0 <= number < len(run.episodes):
        have = f"episodes 0 to {len(run.episodes) - 1}" if run.episodes else "no episode"
        raise RecordingError(f"the recording has {have}: there is no episode {number}. Name another")
    episode = run.episodes[number]
    if episode.first_step:
        raise RecordingError(
            f"episode {number} of the recording begins with its step {episode.first_step}, as in a black box: it "
            "cannot be replayed from its beginning. Replay the run that it belongs to"
        )
    if not len(episode.action):
        raise RecordingError(f"episode {number} of the recording has no action to replay. Name another")
    if not np.isfinite(episode.action).all():
        row = int(np.argmin(np.isfinite(episode.action.reshape(len(episode.action), -1)).all(axis=1)))
        raise RecordingError(
            f"action {row} of episode {number} is not finite: the recording is damaged. Record it anew"
        )
    return episode


def replay(
    run: Run,
    cell: str | Path | CellConfig | None = None,
    *,
    episode: int = 0,
    keywords: Mapping[str, Any] | None = None,
    on_step: Callable[[int, int], None] | None = None,
    on_observation: Callable[[Any], None] = lambda observation: None,
) -> Replay:
    """Replay an episode.

    Args:
        run: The recording.
        cell: Path of a cell file, or another value that `gym.make` takes; None: a simulation of the recorded cell.
        episode: Number of the episode in the order of the recording.
        keywords: Further keywords of `gym.make`.
        on_step: Called after each step with the numbers of steps made and recorded.
        on_observation: Called with the observation of the reset, and with that of each step.

    Raises:
        RecordingError: The recording does not fit this robot or cell, or begins at another configuration. Nothing but
            the reset has moved then.
        DualUR10Error: An error of the environment or the cell.
    """
    source = episode_of(run, episode)
    header = run.header
    again = cell is None and header.source == "mujoco"
    if cell is not None:
        check_replayable(header, resolve_cell(cell))  # before anything is connected to
    made = keywords_of(header, cell)
    made |= {"disable_env_checker": True, **(keywords or {})}
    try:
        env = gym.make(header.env_id, **made)
    except (TypeError, ValueError) as error:
        if isinstance(error, DualUR10Error):
            raise
        raise RecordingError(
            f"the environment of the recording cannot be made: {error}. It is damaged, or of another version"
        ) from error
    try:
        core = env.unwrapped.core  # type: ignore[attr-defined]  # Gymnasium knows only Env
        check_replayable(header, core.config)
        check_same_actions(header, source, core)
        core.pipeline = tap = _Tap(core.pipeline)
        observation: Any = None
        info: dict[str, Any] = {}
        consent = {MOVE_TO_START: True}
        generator = generator_of(generator_text(run, episode), episode)
        if generator is not None:
            env.unwrapped.np_random = generator
            observation, info = env.reset(options=consent)
        else:
            for seed in resets_of(run, episode) if again else [source.seed]:
                observation, info = env.reset(seed=seed, options=consent)
        on_observation(observation)
        found = _play(env, tap, source, info, exact=again, on_step=on_step, on_observation=on_observation)
        if found.success is None:  # the recording was shorter than an episode: no more targets come
            core.cell.finish()
        return found
    finally:
        env.close()


class _Tap:
    """Pipeline that keeps the targets it released last."""

    def __init__(self, pipeline: Any) -> None:
        self._pipeline = pipeline
        self.targets_rad: Array = np.zeros(0)

    def __call__(self, action: object, *context: Any) -> Any:
        command, verdicts = self._pipeline(action, *context)
        self.targets_rad = command.targets_rad[0].copy()
        return command, verdicts

    def __getattr__(self, name: str) -> Any:
        return getattr(self._pipeline, name)


def _play(
    env: Any,
    tap: _Tap,
    source: Episode,
    info: Mapping[str, Any],
    *,
    exact: bool,
    on_step: Callable[[int, int], None] | None,
    on_observation: Callable[[Any], None],
) -> Replay:
    start = np.array(info["q_rad"], dtype=np.float64)
    gap = np.abs(start - source.q_rad[0])
    if gap.max() > _START_RAD:
        arm, joint = np.unravel_index(int(gap.argmax()), gap.shape)
        raise RecordingError(
            f"{ARMS[arm]}: {JOINTS[joint]} is {start[arm, joint]:.4f} rad at the start, and was "
            f"{source.q_rad[0, arm, joint]:.4f} rad in the recording: {_START_RAD} rad apart is the most. The "
            "episode began elsewhere. Replay one that began with a seed"
        )
    joints, flanges, targets = [start], [np.array(info["flange_m"])], []
    equal, difference = 0, _unequal("joints", start, source.q_rad[0], "after the reset") if exact else ""
    ended_by, success, over = "", None, False
    for step, action in enumerate(source.action):
        observation, reward, terminated, truncated, info = env.step(action)
        on_observation(observation)
        targets.append(tap.targets_rad)
        joints.append(np.array(info["q_rad"]))
        flanges.append(np.array(info["flange_m"]))
        where = f"in step {step}"
        equal += int(bits_equal(tap.targets_rad, source.targets_rad[step]).all(axis=(1, 2)).sum())
        difference = difference or _unequal("targets", tap.targets_rad, source.targets_rad[step], where)
        if exact:
            difference = difference or _unequal("joints", joints[-1], source.q_rad[step + 1], where)
            if not difference and float(reward) != float(source.reward[step]):
                difference = f"the reward {where} is {float(reward)!r}, and was {float(source.reward[step])!r}"
        if on_step is not None:
            on_step(step + 1, len(source.action))
        away = float(np.abs(tap.targets_rad - source.targets_rad[step]).max())
        if not exact and away > AWAY_RAD:
            ended_by = f"targets {where} are {away:.3f} rad from the recorded ones, allowed at most {AWAY_RAD} rad"
            break
        over = terminated or truncated
        if over:
            ended_by = early_end(info)
            success = bool(info.get("is_success", False))
            if not difference and step + 1 < len(source.action):
                difference = f"the episode ended {where}, and was {len(source.action)} steps long: {ended_by or 'over'}"
            break
    return Replay(
        steps=len(targets),
        recorded=len(source.action),
        targets_rad=np.array(targets),
        q_rad=np.array(joints),
        flange_m=np.array(flanges),
        equal_targets=equal,
        difference=difference,
        success=success,
        ended_by=ended_by,
        late_actions=env.unwrapped.core.late_actions,
    )


def _unequal(what: str, found: Array, recorded: Array, where: str) -> str:
    """Return the first difference of two arrays, (..., 2, 6), in words; "" if they are equal in every bit."""
    same = bits_equal(found, recorded)
    if same.all():
        return ""
    place = tuple(int(each) for each in np.argwhere(~same)[0])
    arm, joint = place[-2:]
    tick = f", tick {place[0]}" if len(place) > 2 else ""
    return (
        f"{what} {where}{tick} differ: {ARMS[arm]} {JOINTS[joint]} is {float(found[place])!r}, and was "
        f"{float(recorded[place])!r} ({abs(float(found[place] - recorded[place])):.2g} rad apart)"
    )
