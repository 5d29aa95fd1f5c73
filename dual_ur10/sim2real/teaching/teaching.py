"""Teaching: points of guided arms, recorded into a file on request or continuously."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from enum import Enum, auto
from typing import Final

import numpy as np

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.commissioning.findings import REST_RAD_S
from dual_ur10.sim2real.teaching.hand_guiding import STATES_HZ, Guided
from dual_ur10.sim2real.teaching.taught_file import TaughtFile
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

MOST_RATE_HZ: Final = 25.0
"""Largest rate of a continuous record: rows are on the disk one by one."""

STEADY_S: Final = 0.2
"""Duration over which a point is averaged."""

STEP_RAD: Final = 5e-3
"""Least distance of a joint between two points: several times the noise of a hand that holds an arm."""

_STEADY_RAD: Final = 1e-3  # range of a joint meanwhile; 1 mm at 1 m
_REPEAT_S: Final = 2.0  # between two messages of one kind


class TeachKey(Enum):
    """Request of the person who teaches."""

    RECORD = auto()
    END = auto()


class PointRecorder:
    """Recorder of taught points, for `HandGuiding.run`.

    Args:
        file: File of the points.
        arms: Arms of the points.
        keys: Function that returns the next request, or None. It does not wait.
        say: Function that shows a message.
        rate_hz: Rate of a continuous record; None: a point at each request.

    Raises:
        SettingsError: The rate is not legal.
    """

    def __init__(
        self,
        file: TaughtFile,
        arms: Sequence[str],
        keys: Callable[[], TeachKey | None],
        say: Callable[[str], None],
        rate_hz: float | None = None,
    ) -> None:
        if rate_hz is not None and not 0.0 < rate_hz <= MOST_RATE_HZ:
            raise SettingsError(
                f"the rate of a continuous record is {rate_hz!r} Hz: allowed is more than 0, at most {MOST_RATE_HZ:g}"
            )
        self._file, self._keys, self._say, self._rate_hz = file, keys, say, rate_hz
        self._rows = [ARMS.index(arm) for arm in arms]
        self._recent: deque[Guided] = deque(maxlen=math.ceil(STEADY_S * STATES_HZ))
        self._begin_s = 0.0
        self._due_s = -math.inf
        self._last: Array | None = None
        self._said: dict[str, float] = {}
        self.refused = 0
        """Points of a continuous record that `follow` will refuse."""

    def __call__(self, guided: Guided) -> bool:
        """Take a state. Return False at the end.

        Raises:
            TrajectoryError: A point cannot be written.
        """
        self._recent.append(guided)
        for text in guided.warnings:
            what, _, _ = text.partition(" are ")  # with other numbers, it is the same message
            if guided.time_s >= self._said.get(what, -math.inf) + _REPEAT_S:
                self._said[what] = guided.time_s
                self._say(f"note: {text}")
        key = self._keys()
        if self._rate_hz is not None and (guided.time_s >= self._due_s or key is TeachKey.END):
            self._due_s = max(self._due_s, guided.time_s - 1.0 / STATES_HZ) + 1.0 / self._rate_hz
            self._record_passing(guided)
        elif key is TeachKey.RECORD:
            self._record_resting(guided)
        return key is not TeachKey.END

    def _record_passing(self, guided: Guided) -> None:
        if self._is_new(guided.q_rad):
            self.refused += bool(guided.refusal)
            self._add(guided.time_s, guided.q_rad)

    def _record_resting(self, guided: Guided) -> None:
        q = np.array([each.q_rad for each in self._recent])
        speed = max(float(np.abs(each.qd_rad_s).max()) for each in self._recent)
        spread = float(np.ptp(q, axis=0).max())
        if len(self._recent) < self._recent.maxlen or not (speed < REST_RAD_S and spread < _STEADY_RAD):  # type: ignore[operator]  # it has a length
            self._say(
                f"nothing was recorded: in the last {STEADY_S:g} s the arms moved at {speed:.3f} rad/s and by "
                f"{1e3 * spread:.1f} mrad, allowed are {REST_RAD_S:g} rad/s and {1e3 * _STEADY_RAD:g} mrad. "
                "Hold them still"
            )
        elif guided.refusal:
            self._say(f"nothing was recorded: `follow` would refuse this point, {guided.refusal}")
        elif not self._is_new(mean := q.mean(axis=0)):
            self._say(
                f"nothing was recorded: no joint is {1e3 * STEP_RAD:g} mrad from the point before. Move an arm first"
            )
        else:
            self._add(guided.time_s, mean)
            self._say(f"point {self._file.count} is in {self._file.path}")

    def _is_new(self, q_rad: Array) -> bool:
        return self._last is None or float(np.abs(q_rad - self._last)[self._rows].max()) >= STEP_RAD

    def _add(self, time_s: float, q_rad: Array) -> None:
        if self._last is None:
            self._begin_s = time_s
        self._last = q_rad
        self._file.add(time_s - self._begin_s, q_rad[self._rows])
