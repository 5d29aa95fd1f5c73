"""Session in a live page: one loop steps an environment, led by a policy, an operator, or both."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dual_ur10.envs.core.options import MOVE_TO_START
from dual_ur10.envs.rendering.live.buttons import POLICIES, SPEEDS
from dual_ur10.envs.rendering.live.live_page import LivePage
from dual_ur10.envs.rendering.live.shown import Shown
from dual_ur10.errors import CellFaulted, DualUR10Error, RenderError, SettingsError
from dual_ur10.policies.evaluation.rollout import act
from dual_ur10.policies.operators.page import PageDevice
from dual_ur10.policies.operators.takeover import Takeover
from ur_core.types import Array

if TYPE_CHECKING:
    from dual_ur10.policies.operators.operator import Operator

_LOG: Final = logging.getLogger(__name__)
_IDLE_S: Final = 0.02
_DROPPED_S: Final = 0.5  # a delay of a simulation beyond this is not made up for


class LiveSession:
    """Loop that steps an environment, led by a policy, an operator, or both, and shows it.

    Args:
        env: Environment of one cell.
        policy: Policy; None: nobody but the operator leads.
        operator: Operator, who takes arms from the policy if there is one; None: nobody takes an arm.
        page: The page.
        seed: Seed of the first episode; the next ones count up.
        policies: Names of the policies between which the page switches; the first one acts.
        make: Function that returns the environment, the policy and the operator for one of these names.
        report: Function that is told of a latched stop, beside the page.

    Attributes:
        shown: The environment as the page shows it. A switch of the policy replaces it.
        operator: As above.
    """

    def __init__(
        self,
        env: Any,
        policy: Any | None,
        operator: Operator | None,
        page: LivePage,
        seed: int,
        policies: Sequence[str] = (),
        make: Callable[[str], tuple[Any, Any, Operator | None]] | None = None,
        report: Callable[[str], None] = _LOG.error,
    ) -> None:
        self._page, self._policies, self._make, self._report = page, policies, make, report
        self._use(env, policy, operator)
        if policy is None or policies:
            self.shown.words["policy"] = "none: the operator leads" if policy is None else policies[0]
        self._device = PageDevice(page) if operator is None else operator.device
        self._controllers = bool(self._core.config.controllers)
        self._seed = seed
        self._speed = 1.0
        self._observation: Any = None
        self._over = ""
        self._stopped = self._fault = ""
        self._paused = False
        self._single = False

    def _use(self, env: Any, policy: Any | None, operator: Operator | None) -> None:
        """Go on with an environment, and with who acts in it."""
        self.shown = Shown(env, self._page, "nobody" if policy is None else "policy")
        self.operator = operator
        if operator is not None:
            operator.stops = False  # the session stops, and goes on showing the arms
        self._core = env.unwrapped.core
        self._actor = policy if operator is None else operator if policy is None else Takeover(policy, operator)
        self._period_s = self._core.timing.period_s

    def run(self, seconds: float | None) -> None:
        """Run until the time is over, or Ctrl-C.

        Raises:
            RenderError: The page's process has ended, or hangs. On controllers both arms have a latched stop: nobody
                could press the button any more.
            CellFaulted: It has ended after a latched stop of both arms.
        """
        try:
            self._loop(seconds)
        except KeyboardInterrupt:
            if not self._fault:
                raise
        if self._fault:
            raise CellFaulted(self._fault)

    def _loop(self, seconds: float | None) -> None:
        end_s = math.inf if seconds is None else time.monotonic() + seconds
        self.begin(self._seed)
        due_s = time.monotonic()
        while time.monotonic() < end_s:
            if lost := self._page.lost:
                gone = f"the live page is gone: {lost}"
                raise RenderError(self._core.stop(gone) or f"{gone}: start the program again")
            self.shown.late_s = max(0.0, time.monotonic() - due_s)
            try:
                moved = self.turn()
            except CellFaulted as error:
                self._latch(str(error))
                moved = False
                self._say()
            # Against the clock, not from step to step, so that delays do not add up.
            now_s = time.monotonic()
            due_s = max(due_s + (self._period_s / self._speed if moved else _IDLE_S), now_s - _DROPPED_S)
            if self._core.setup.keeps_time and moved:
                due_s = now_s  # the controllers keep the time
            time.sleep(max(0.0, due_s - now_s))

    def turn(self) -> bool:
        """Act on buttons, and take one step if there is one to take. Return True if there was."""
        if self._rests:
            self._act_on(self._device.read().buttons)
            if self._rests:
                self._say()
            return not self._rests
        episode, actor = self.shown.episode, self._actor
        action = self._still() if actor is None else act(actor, self._observation, self.shown, np.float32)
        self._act_on(self._device.read().buttons if self.operator is None else self.operator.buttons)
        if self.shown.episode != episode:
            return True
        if self._rests:
            return False
        self._single = False
        self._tell()
        self._observation, _, terminated, truncated, info = self.shown.step(self._still() if self._stopped else action)
        # Who practises in a simulation may go on when the time of the task is over.
        led = self.operator is not None and self.operator.commander.any()
        if terminated or (truncated and (self._controllers or not led)):
            self._over = str(info.get("end_reason", "over"))
            if not (led or self._controllers):
                self.begin(self._seed + 1)
        return True

    @property
    def _rests(self) -> bool:
        """True while no step is taken."""
        return bool(self._over or (self._stopped and self._controllers) or (self._paused and not self._single))

    def _still(self) -> Array:
        """Return the action that leaves both arms where they are commanded to be; grippers stay."""
        adapter, space = self._core.pipeline.adapter, self._core.action_space
        action = np.zeros((2, adapter.action_size))
        if adapter.mode == "joint_position":
            action[:, :6] = adapter.commanded_q_rad[0]
        if adapter.gripper:
            widths = self._core.pipeline.commanded_widths_m[0]
            action[:, 6] = 2.0 * widths / adapter.stroke_m - 1.0
        still: Array = action.reshape(space.shape).astype(space.dtype)
        return still

    def _act_on(self, pressed: frozenset[str]) -> None:
        """Act on the buttons of the device and on those of the page, which may be another one."""
        pressed |= frozenset(self._page.pressed())
        for name in pressed & {"record", "success", "discard"}:
            text = f"{name} at step {self.shown.steps} of episode {self.shown.episode}"
            self._core.note("button", text)
            self.shown.words["record"] = text
        if "pause" in pressed:
            self._paused = not self._paused
        if "step" in pressed:
            self._paused = self._single = True
        for name in pressed & SPEEDS.keys():
            self._speed = SPEEDS[name]
        chosen = [policy for name, policy in zip(POLICIES, self._policies, strict=False) if name in pressed]
        if "stop" in pressed and not self._stopped:
            self._stop()
        elif chosen:
            self._switch(chosen[0])
        elif {"reset", "next_seed"} & pressed:
            self.begin(self._seed + ("next_seed" in pressed))

    def _stop(self) -> None:
        """Stop both arms: latched on controllers, until the next reset in simulation."""
        text = self._core.stop("the button to stop both arms was pressed in the live page")
        if self._controllers:
            self._latch(text)
        else:
            self._stopped = "STOPPED by the page: press Reset to go on"
        self._core.note("stop", "button of the live page")

    def _latch(self, text: str) -> None:
        """Show a latched stop, and report it: perhaps no page is open."""
        if not self._stopped:
            self._report(text)
        self._stopped, self._fault = f"LATCHED: {text}", text

    def _switch(self, name: str) -> None:
        """Let another policy act in an environment that fits it, from the beginning of the episode on.

        One that cannot be used is named in the page, and nothing else changes.
        """
        if self._make is None or self._controllers:
            return
        before, made = self.shown, None
        before.words["policy"] = f"{name} is loaded"
        before.say()
        try:
            made, policy, operator = self._make(name)
            if made.unwrapped.core.config.scene != self._core.config.scene:
                raise SettingsError("it is for another scene than the page shows: start the program with it")
        except DualUR10Error as error:
            if made is not None:
                made.close()
            before.words["policy"] = f"REFUSED {name}: {error}"
            return
        self._use(made, policy, operator)
        self.shown.episode, self.shown.words = before.episode, {**before.words, "policy": name}
        before.close()
        self.begin(self._seed)

    def begin(self, seed: int) -> None:
        """Begin the episode of a seed. A latched stop stays."""
        if self._stopped and self._controllers:
            return  # a latched stop is cleared by a person at the controllers
        self._seed = seed
        again = self.shown.episode >= 0 and self._controllers
        self._over, self._stopped = "", ""
        if self._actor is not None:
            self._actor.reset()
        if self.operator is not None:
            self._core.commander = self.operator.commander
        self._tell()
        self._observation, _ = self.shown.reset(seed=seed, options={MOVE_TO_START: True} if again else None)

    def _tell(self) -> None:
        """Let the page know what the loop waits for."""
        shown = self.shown
        paused, speed = "paused" if self._paused else "", "" if self._speed == 1.0 else f"{self._speed:g}× speed"
        shown.state = f"over: {self._over}" if self._over else ", ".join(filter(None, (speed, paused)))
        if not self._controllers:
            shown.stopped = self._stopped
        elif self._stopped:
            shown.words["program"] = self._stopped

    def _say(self) -> None:
        self._tell()
        self.shown.say()
