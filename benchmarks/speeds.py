"""Watches the joint speeds of a policy while it is evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dual_ur10.envs.tasks.task import Task
from dual_ur10.types import Rows


class SpeedWatch:
    """Stands between an evaluation and a policy, and keeps the largest joint speed that it sees.

    Speeds are differences of the observed joint positions over control periods, so that noise of the positions is in
    them. The last step of each episode is not: nobody acts after it.

    Args:
        policy: What acts, told of episodes as `EpisodeAware` says.
        period_s: Control period.
        task: Class of the task: its speed limits, and the layout of its observations.
    """

    def __init__(self, policy: Any, period_s: float, task: type[Task[Any, Any]]) -> None:
        self._policy, self._period_s, self._task = policy, period_s, task
        self._last: np.ndarray | None = None
        self.share = 0.0

    def reset(self) -> None:
        """All rows begin episodes."""
        self._last = None
        self._policy.reset()

    def begin(self, rows: Rows, seeds: Sequence[int]) -> None:
        """Rows begin episodes."""
        if self._last is not None:
            self._last[rows] = np.nan
        self._policy.begin(rows, seeds)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The policy's actions."""
        q = self._task.layout.split(observation)["q_rad"].copy()
        if self._last is not None:
            share = np.abs(q - self._last) / self._period_s / np.asarray(self._task.limits.speed_rad_s)
            self.share = max(self.share, float(np.nanmax(share, initial=0.0)))
        self._last = q
        return self._policy(observation)
