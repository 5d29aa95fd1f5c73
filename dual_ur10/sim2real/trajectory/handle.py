"""Handle of a goal: its state, feedback and result, and the commands that concern it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from dual_ur10.sim2real.trajectory.goal import Feedback, GoalResult, GoalState, TrajectoryGoal
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, ResultCode
from ur_core.types import Array

if TYPE_CHECKING:
    from dual_ur10.sim2real.trajectory.executor import TrajectoryExecutor


class GoalHandle:
    """Goal that an executor has taken or rejected.

    Args:
        executor: The executor.
        goal: The goal.

    Attributes:
        goal: The goal; a stream's trajectory grows.
        state: State of the goal.
        result: Result; None until the state is final.
        feedback: Newest feedback; None until the goal is active.
        reason: Reason of a stop that goes on, as in `GoalResult`; "": there is none.
        text: Description of that stop.
        over_s: Time on the executor's clock at which the commanded motion ended; None: it has not.
    """

    def __init__(self, executor: TrajectoryExecutor, goal: TrajectoryGoal) -> None:
        self._executor, self.goal = executor, goal
        self.state = GoalState.PENDING
        self.result: GoalResult | None = None
        self.feedback: Feedback | None = None
        self.reason, self.text = "", ""
        self.over_s: float | None = None
        # Of six joints and the flange of each arm.
        self._largest: Array = np.zeros((len(goal.trajectory.arms), 7))
        self._squares: Array = np.zeros_like(self._largest)
        self._count = 0

    def step(self) -> Feedback | None:
        """Advance the cell by one period, and return the newest feedback; None while the goal has not begun."""
        self._executor.step()
        return self.feedback

    def wait(self, on_feedback: Callable[[Feedback], None] | None = None) -> GoalResult:
        """Advance the cell until the goal has ended and both arms rest, and return the result.

        Args:
            on_feedback: Called with the feedback of each period.
        """
        while self.result is None or self._executor.moves:
            before = self.feedback
            self._executor.step()
            if on_feedback is not None and self.feedback is not None and self.feedback is not before:
                on_feedback(self.feedback)
        return self.result

    def cancel(self) -> None:
        """Let both arms stop on their path; the goal ends as preempted. A goal that has ended stays as it is."""
        self._executor.cancel(self)

    def append(self, points: JointTrajectory) -> None:
        """Append points to a goal that streams, on the same time base.

        Raises:
            TrajectoryError: The goal is no stream or has ended, or the points do not continue it. Nothing changes.
        """
        self._executor.append(self, points)

    def complete(self) -> None:
        """End the stream: its last point, at rest, is the goal.

        Raises:
            TrajectoryError: The goal is no stream or has ended, or the last point moves. Nothing changes.
        """
        self._executor.complete(self)

    def note(self, feedback: Feedback) -> None:
        """Keep a feedback, and add its errors to the statistics. For the executor."""
        self.feedback = feedback
        errors = np.concatenate([np.abs(feedback.error_rad), feedback.flange_error_m[:, None]], axis=1)
        self._largest = np.maximum(self._largest, errors)
        self._squares += errors**2
        self._count += 1

    def end(self, state: GoalState, code: ResultCode, reason: str, text: str, time_s: float) -> None:
        """Enter a final state, the first time. For the executor."""
        if self.result is not None:
            return
        self.state = state
        largest, rms = self._largest, np.sqrt(self._squares / max(self._count, 1))
        self.result = GoalResult(
            state, code, reason, text, time_s, largest[:, :6], rms[:, :6], largest[:, 6], rms[:, 6]
        )
