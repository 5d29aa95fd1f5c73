"""Frames of recorded episodes on a constant grid, as the columns of a dataset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import DatasetError, RecordingError
from dual_ur10.lerobot.features import ACTION, ENV_ACTION, ENVIRONMENT_STATE, STATE
from dual_ur10.policies.learned.signature import EnvironmentView, view_of
from dual_ur10.sim2real.analysis.reconstruction import keywords_of
from dual_ur10.sim2real.recording.run import Episode, Header
from ur_core.types import Array

Columns = Mapping[str, NDArray[Any]]

_COMMANDED: Final = "commanded_q_rad"
_WIDTH: Final = "gripper_m"
_ROUNDING: Final = 1e-6


@dataclass(frozen=True)
class RecordedView:
    """Environment of recorded runs, as far as the columns of their episodes depend on it.

    Attributes:
        env_id: Id of the environment.
        view: Signature and layout of its observations.
        stroke_m: (2,) largest width of each gripper; None: there are none.
        fps: Frames per second: steps of the environment.
    """

    env_id: str
    view: EnvironmentView
    stroke_m: Array | None
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
        commanded, width = self._commanded(episode.observation), self._measured(episode.observation)
        commander = np.zeros((count, 2), dtype=np.int64)
        if episode.commander is not None:
            commander[:] = episode.commander
        last, success = np.zeros((2, count), dtype=bool)
        last[-1:], success[-1:] = True, bool(episode.success)
        return {
            STATE: _joined(commanded[:-1], None if width is None else width[:-1]),
            ENVIRONMENT_STATE: episode.observation[:-1].astype(np.float32),
            ACTION: _joined(commanded[1:], self._widths(episode)),
            ENV_ACTION: episode.action.astype(np.float32),
            "next.reward": episode.reward.astype(np.float32),
            "next.done": last,
            "next.success": success,
            "commander": commander,
            "intervention": commander.max(axis=1) > 0,
        }

    def _commanded(self, observation: Array) -> Array:
        """Return the commanded joints, (m + 1, 2, 6), that observations show."""
        if self.view.setup.options.concise:
            shown: Array = self.view.setup.make_task().concise_view().commanded_q_rad(observation)
            return shown
        found: Array = self.view.layout.split(observation)[_COMMANDED]
        return found

    def _measured(self, observation: Array) -> Array | None:
        """Return the measured widths, (m + 1, 2), as fractions of the strokes; None: there are no grippers."""
        if self.stroke_m is None:
            return None
        if _WIDTH not in self.view.layout.names:
            return np.ones((len(observation), 2))
        found: Array = self.view.layout.split(observation)[_WIDTH][..., 0] / self.stroke_m
        return found

    def _widths(self, episode: Episode) -> Array | None:
        """Return the commanded widths, (m, 2), as fractions of the strokes; None: there are no grippers."""
        if self.stroke_m is None:
            return None
        if episode.gripper_m is None:
            size = episode.action.shape[1] // 2
            ratio: Array = (np.clip(episode.action[:, size - 1 :: size], -1.0, 1.0) + 1.0) / 2.0
            return ratio
        found: Array = episode.gripper_m[:, -1] / self.stroke_m
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
    if _COMMANDED not in view.layout.names:
        raise RecordingError(
            f"the observations of {header.env_id} have no field {_COMMANDED!r}: begin the layout of its task with "
            "ARM_FIELDS"
        )
    period_s = header.tick_s * header.period_ticks
    fps = round(1.0 / period_s)
    if fps < 1 or abs(fps * period_s - 1.0) > _ROUNDING:
        raise DatasetError(
            f"a step takes {period_s:g} s: LeRobot's datasets have a whole number of frames per second, as with "
            "policy_rate_hz=25. Record the run anew at such a rate"
        )
    setup = view.setup
    stroke_m = setup.make_adapter().stroke_m if view.signature.actions.gripper else None
    return RecordedView(header.env_id, view, stroke_m, fps)


def _joined(joints_rad: Array, widths: Array | None) -> NDArray[np.float32]:
    """Return positions, (m, 12 or 14), in float32: of each arm the joints and, if it has one, the gripper."""
    parts = [joints_rad] if widths is None else [joints_rad, widths[:, :, None]]
    found: NDArray[np.float32] = np.concatenate(parts, axis=2).reshape(len(joints_rad), -1).astype(np.float32)
    return found
