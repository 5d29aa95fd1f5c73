"""Frames of recorded episodes on a constant grid, as the columns of a dataset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import DatasetError, RecordingError
from dual_ur10.lerobot.features import ACTION, ENV_ACTION, ENVIRONMENT_STATE, STATE
from dual_ur10.lerobot.positions import Positions, joined
from dual_ur10.policies.learned.signature import EnvironmentView, view_of
from dual_ur10.sim2real.analysis.reconstruction import keywords_of
from dual_ur10.sim2real.recording.run import Episode, Header
from ur_core.types import Array

Columns = Mapping[str, NDArray[Any]]

_ROUNDING: Final = 1e-6


@dataclass(frozen=True)
class RecordedView:
    """Environment of recorded runs, as far as the columns of their episodes depend on it.

    Attributes:
        env_id: Id of the environment.
        view: Signature and layout of its observations.
        positions: Positions of both arms in them.
        fps: Frames per second: steps of the environment.
    """

    env_id: str
    view: EnvironmentView
    positions: Positions
    fps: int

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.env_id}, {self.fps} fps, {self.view.layout!r})"

    def columns(self, episode: Episode, what: str) -> dict[str, NDArray[Any]]:
        """Return the columns of an episode of m steps, each (m, size), or (m,) of single values.

        `STATE` holds the commanded joints and the measured gripper widths at the begin of a step, and `ACTION` the
        joints and widths that are commanded at its end, which are the actions of `action_mode="joint_position"`.

        Args:
            episode: The episode.
            what: Noun for messages.

        Raises:
            RecordingError: It has no observations, or actions or observations of another size.
        """
        count = len(episode.reward)
        if episode.first_step:
            raise RecordingError(f"{what} begins within an episode, as in a black box: export the run it belongs to")
        if episode.observation is None:
            raise RecordingError(f"{what} has no observations: record it with an environment, not with a program")
        expected = (count, *self.view.signature.action.shape), (count + 1, *self.view.signature.observation.shape)
        for name, values, shape in zip(
            ("actions", "observations"), (episode.action, episode.observation), expected, strict=True
        ):
            if values.shape != shape:
                raise RecordingError(f"{name} of {what} have shape {values.shape}, expected is {shape}")
        commanded = self.positions.commanded(episode.observation)
        commander = np.zeros((count, 2), dtype=np.int64)
        if episode.commander is not None:
            commander[:] = episode.commander
        last, success = np.zeros((2, count), dtype=bool)
        last[-1:], success[-1:] = True, bool(episode.success)
        return {
            STATE: self.positions.state(episode.observation)[:-1],
            ENVIRONMENT_STATE: episode.observation[:-1].astype(np.float32),
            ACTION: joined(commanded[1:], self._widths(episode)),
            ENV_ACTION: episode.action.astype(np.float32),
            "next.reward": episode.reward.astype(np.float32),
            "next.done": last,
            "next.success": success,
            "commander": commander,
            "intervention": commander.max(axis=1) > 0,
        }

    def _widths(self, episode: Episode) -> Array | None:
        """Return the commanded widths, (m, 2), as fractions of the strokes; None: there are no grippers."""
        if self.positions.stroke_m is None:
            return None
        if episode.gripper_m is None:
            size = episode.action.shape[1] // 2
            ratio: Array = (np.clip(episode.action[:, size - 1 :: size], -1.0, 1.0) + 1.0) / 2.0
            return ratio
        found: Array = episode.gripper_m[:, -1] / self.positions.stroke_m
        return found


def view_of_run(header: Header) -> RecordedView:
    """Return the environment of a recorded run.

    Raises:
        RecordingError: It cannot be made again, or its observations do not show what is commanded.
        DatasetError: Its rate is no whole number of frames per second.
    """
    keywords = keywords_of(header)
    if header.kwargs.get("observation") == "goals":  # of controllers, too
        keywords["observation"] = "goals"
    elif keywords.get("observation") != "goals":
        keywords.pop("observation", None)
    view = view_of(header.env_id, keywords)
    period_s = header.tick_s * header.period_ticks
    fps = round(1.0 / period_s)
    if fps < 1 or abs(fps * period_s - 1.0) > _ROUNDING:
        raise DatasetError(
            f"a step takes {period_s:g} s: LeRobot's datasets have a whole number of frames per second, as with "
            "policy_rate_hz=25. Record the run anew at such a rate"
        )
    return RecordedView(header.env_id, view, Positions(view), fps)
