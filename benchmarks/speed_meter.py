"""Largest joint speed of a policy during an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dual_ur10.envs.tasks.task import Task
from ur_core.types import Rows


class SpeedMeter:
    """Wrapper of a policy that keeps the largest joint speed over its limit.

    Speeds are differences of the observed joint positions over policy periods, so that they
    contain the noise of the positions. The last step of each episode is left out: no action follows it.

    Args:
        policy: The acting policy, an `EpisodeAware`.
        period_s: Policy period.
        task: Class of the task: its speed limits, and the layout of its observations.
    """

    def __init__(self, policy: Any, period_s: float, task: type[Task[Any, Any]]) -> None:
        self._policy, self._period_s, self._task = policy, period_s, task
        self._last: np.ndarray | None = None
        self.ratio = 0.0

    def reset(self) -> None:
        """Begin episodes in all rows."""
        self._last = None
        self._policy.reset()

    def begin(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Begin episodes in some rows."""
        if self._last is not None:
            self._last[rows] = np.nan
        self._policy.begin(rows, seeds)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the actions of the policy."""
        q = self._task.layout.split(observation)["q_rad"].copy()
        if self._last is not None:
            ratio = np.abs(q - self._last) / self._period_s / np.asarray(self._task.limits.speed_rad_s)
            self.ratio = max(self.ratio, float(np.nanmax(ratio, initial=0.0)))
        self._last = q
        return self._policy(observation)
