"""Policy of which a person takes one arm or both at any action, and hands them back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from dual_ur10.policies.operators.operator import Operator
from dual_ur10.policies.policy import Policy, TimeAware, as_policy, close_policy
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array, Mask

TAKE_S, HAND_BACK_S = 0.2, 0.3
"""Times in which an arm passes from its last motion to that of the hand, and to that of the policy.

At once, the corner in what is commanded would be rounded by up to 4 mm, since accelerations are limited.
"""

_TAKES: Final = {"take_left": (0,), "take_right": (1,), "take_both": (0, 1)}
_HANDS_BACK: Final = "hand_back"


class Takeover:
    """Policy that acts until a person takes one arm or both, and again once they are handed back.

    Buttons of the device say who commands: "take_left", "take_right", "take_both", and "hand_back" for all taken arms.
    They count in the same action. Whoever commands goes on from the commanded joint positions, and the adapter keeps
    every limit, so that nothing pauses and nothing jumps:

    - An arm that is taken passes from its motion to that of the hand in 0.2 s; with a hand at rest it stops.
    - The gripper of an arm that is taken stays as it is, until the person uses it. A trigger counts once it has come to
      where the gripper is.
    - An arm that is handed back passes from its last motion to that of the policy in 0.3 s. Its gripper is the policy's
      at once.
    - The policy observes and acts in every period, also while both of its arms are taken.
    - A leader more than 0.6 rad from its arm does not take it.

    An episode begins with the policy.

    Args:
        policy: Policy of the same environment as the operator.
        operator: Operator; `close` closes its device.
        tell: Function that is given what has changed, in words.

    Attributes:
        commander: (2,) True for an arm that the person commands, led or at rest.
        device: Device of the operator.
    """

    def __init__(
        self, policy: Policy | Callable[[Any], Any], operator: Operator, tell: Callable[[str], None] = lambda text: None
    ) -> None:
        self.policy, self.operator, self._tell = as_policy(policy), operator, tell
        self.device = operator.device
        operator.on_buttons, operator.asks = self._press, True
        name = getattr(policy, "__name__", type(policy).__name__)
        self.__name__ = f"{name}, taken over with {operator.device.name}"  # in results and records
        self._most = operator.step_rad if operator.action_mode == "joint_position" else np.ones(6)
        self._period_s = operator.timing.period_s
        self.reset()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.policy!r}, {self.operator!r})"

    @property
    def commander(self) -> Mask:
        """(2,) True for an arm that the person commands."""
        return self.operator.commander

    def reset(self) -> None:
        """Begin an episode, which the policy commands."""
        self.policy.reset()
        self.operator.reset()
        self.operator.commander = np.zeros(2, dtype=bool)
        self._opening: Array = np.ones(2)  # sent last
        self._step: Array = np.zeros((2, 6))  # likewise, from the commanded joints or as a fraction
        self._from: Array = np.zeros((2, 6))  # steps from which arms pass to those of their new commander
        self._ratio: Array = np.ones(2)  # of the new commander in the motion of each arm
        self._new: set[int] = set()  # arms taken in this action
        self._explained: set[int] = set()

    def close(self) -> None:
        """Close the device, and the policy if it can be closed. May be called twice."""
        self.operator.close()
        close_policy(self.policy)

    def observed_at(self, time_s: Array) -> None:
        """Give the policy the time of the next observation; see `dual_ur10.policies.policy.TimeAware`."""
        if isinstance(self.policy, TimeAware):
            self.policy.observed_at(time_s)

    def __call__(self, observation: Any) -> Array:
        """Return the float32 action for the observation of one cell, or for a batch of one.

        Raises:
            ActionError: It is not one observation.
            DeviceError: One of its kinds: the device is gone, silent, or not understood, whoever commands.
            Exception: As raised by the policy, whoever commands.
        """
        self._new.clear()
        wanted = np.asarray(self.policy(observation), dtype=np.float64)
        led = self.operator(observation)
        for arm, reason in self.operator.refusals.items():
            self._explain(arm, reason)
        person, policy = (each.astype(np.float64).reshape(2, -1) for each in (led, wanted))
        origin = self.operator.commanded_q_rad if self.operator.action_mode == "joint_position" else np.zeros((2, 6))
        taken = self.commander[:, None]
        wished = np.where(taken, person, policy)
        step = wished[:, :6] - origin
        self._ratio = np.minimum(self._ratio + self._period_s / np.where(self.commander, TAKE_S, HAND_BACK_S), 1.0)
        ratio = self._ratio[:, None]
        part = ratio * np.clip(step, -self._most, self._most) + (1.0 - ratio) * self._from
        step = np.where(ratio < 1.0, part, step)
        action = np.concatenate([origin + step, wished[:, 6:]], axis=1)
        self._step = np.clip(step, -self._most, self._most)
        if action.shape[1] > 6:
            self._opening = (np.clip(action[:, 6], -1.0, 1.0) + 1.0) / 2.0
        return action.reshape(led.shape).astype(np.float32)

    def _press(self, buttons: frozenset[str]) -> None:
        """Take arms and hand them back."""
        for name, arms in _TAKES.items():
            if name not in buttons:
                continue
            self.operator.lead(arms[0])
            for arm in arms:
                if not self.commander[arm]:
                    self._take(arm)
        if _HANDS_BACK in buttons:
            for arm in np.flatnonzero(self.commander).tolist():
                self._hand_back(arm)
                self._tell(f"the {ARMS[arm]} arm is handed back")

    def _take(self, arm: int) -> None:
        self.operator.take(arm, float(self._opening[arm]))
        self._new.add(arm)
        self._pass(arm)
        self._tell(f"the {ARMS[arm]} arm is taken")

    def _hand_back(self, arm: int) -> None:
        self.operator.commander[arm] = False
        self._pass(arm)

    def _pass(self, arm: int) -> None:
        self._from[arm], self._ratio[arm] = self._step[arm], 0.0

    def _explain(self, arm: int, reason: str) -> None:
        """Say once why a leader does not lead its arm; one that has just taken it gives it back."""
        if arm in self._new:
            self._hand_back(arm)
            self._ratio[arm] = 1.0
            self._tell(f"the {ARMS[arm]} arm is not taken: {reason}")
        elif arm not in self._explained:
            self._explained.add(arm)
            self._tell(reason)
