"""The grippers of a cell of controllers: a thread for each, so that no gripper keeps the arms waiting."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, TypeVar

from dual_ur10.assets.gripper import OPENING_M
from dual_ur10.errors import ActionError, ClosedError, DualUR10Error, LinkError, OperationRefusedError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.config.cell_file import CellFile
from dual_ur10.sim2real.config.cell_file_entries import ArmEntry, DigitalGripper, RobotiqSocket
from dual_ur10.sim2real.peripherals.digital_gripper import DigitalGripperLink
from dual_ur10.sim2real.peripherals.gripper_link import GripperLink, RobotiqLink
from dual_ur10.types import Closing

log = logging.getLogger(__name__)

STALE_S: Final = 1.0
"""A gripper that has not been heard for so long is a fault: its answers have half a second each."""

ACTIVATION_S: Final = 10.0
"""Within how long a gripper must become active."""

_POLL_S: Final = 0.02
_MOST_WAITING: Final = 256  # commands; a quarter of a second ahead is 125 at most
_SLACK_M: Final = 1e-9

T = TypeVar("T")


class GripperThread:
    """One gripper. All but `activate` and `close` return at once.

    Args:
        name: Of the arm.
        link: To the gripper; it is this object's from now on.
        poll_s: How often it is asked how it is.
        may: Asked in its thread when a command is due: whether that still holds.

    Raises:
        LinkError: It does not tell.
    """

    def __init__(
        self, name: str, link: GripperLink, poll_s: float = _POLL_S, may: Callable[[], bool] = lambda: True
    ) -> None:
        self.name = name
        self._link, self._poll_s, self._may = link, poll_s, may
        self._reading = link.read()
        self._read_s = time.monotonic()
        self._lost = ""
        self._closed = False
        self._waiting: deque[tuple[float, float]] = deque()
        self._using = threading.Lock()  # the link: held for one call at a time, or an activation
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=f"{name} gripper", daemon=True)
        self._thread.start()

    @property
    def opening_m(self) -> float | None:
        """Opening that was measured last, 0 to `OPENING_M`; None if it does not tell."""
        return self._reading.opening_m

    @property
    def holding(self) -> bool | None:
        """Whether an object stops the fingers; None if it does not tell."""
        return self._reading.holding

    @property
    def measured_s(self) -> float:
        """When that was measured, on the clock of `time.monotonic`."""
        return self._read_s

    @property
    def fault(self) -> str:
        """Why it would not do what it is told, with its arm, or "". Once it was lost, it is lost."""
        if self._lost:
            return self._lost
        if self._reading.fault:
            return f"{self._link.where}: {self._reading.fault}"
        age_s = time.monotonic() - self._read_s
        if age_s > STALE_S and not self._closed:
            return f"{self._link.where}: not heard for {age_s:.1f} s; check the controller and the network"
        return ""

    def command(self, opening_m: float, at_s: float) -> None:
        """Open or close, at a time. What was to come then or later is forgotten; of several due, the last is sent.

        Args:
            opening_m: Distance of the fingers to go to, 0 to `OPENING_M`.
            at_s: When, on the clock of `time.monotonic`; at once if that is past.

        Raises:
            ActionError: That is no opening that it has, or no time.
            ClosedError: It was closed.
        """
        if not (-_SLACK_M <= opening_m <= OPENING_M + _SLACK_M and math.isfinite(at_s)):
            raise ActionError(
                f"the {self.name} gripper is to open to {opening_m!r} m at {at_s!r} s: allowed are 0 to {OPENING_M} m, "
                "at a finite time"
            )
        if self._closed:
            raise ClosedError(f"the {self.name} gripper was closed: make another")
        with self._changed:
            while self._waiting and self._waiting[-1][0] >= at_s:
                self._waiting.pop()
            self._waiting.append((at_s, float(opening_m)))
            while len(self._waiting) > _MOST_WAITING:
                self._waiting.popleft()
            self._changed.notify()

    def forget(self) -> None:
        """Somebody else may have moved it: the next command is sent, also if it is the same as the last.

        Raises:
            LinkError: It was lost.
        """
        self._directly(self._link.forget)

    def needs_activation(self) -> bool:
        """Whether it must be activated before it takes commands. It is asked, and waited for.

        Raises:
            LinkError: It was lost.
        """
        return self._directly(self._link.needs_activation)

    def activate(self, within_s: float = ACTIVATION_S) -> None:
        """Activate it, and wait for the end. Its fingers open, and may close before; what they held falls.

        Commands that wait are forgotten: what is due next comes after the activation.

        Raises:
            LinkError: It was lost, or did not become active by then.
        """

        def act() -> None:
            with self._changed:
                self._waiting.clear()
            self._link.activate(within_s)
            self._ask()

        self._directly(act)

    def _directly(self, act: Callable[[], T]) -> T:
        """Do it between two calls of the thread."""
        with self._using:
            if self._lost:
                raise LinkError(self._lost)
            if self._closed:
                raise ClosedError(f"the {self.name} gripper was closed: make another")
            try:
                return act()
            except LinkError as error:
                self._lose(str(error))
                raise

    def _ask(self) -> None:
        self._reading = self._link.read()
        self._read_s = time.monotonic()

    def _lose(self, text: str) -> None:
        self._lost = text
        log.error("%s", text)
        self._link.close()

    def _run(self) -> None:
        next_s = time.monotonic()
        while True:
            self._wait(next_s)
            with self._using:
                if self._closed or self._lost:
                    return
                try:
                    opening_m = self._due()  # not before: an activation may just have made it obsolete
                    if opening_m is not None:
                        self._link.command(opening_m)
                    if time.monotonic() >= next_s:
                        self._ask()
                        next_s = time.monotonic() + self._poll_s
                except DualUR10Error as error:
                    self._lose(str(error))
                except Exception as error:  # whatever it is, the program must hear of it
                    self._lose(f"{self._link.where}: {type(error).__name__}: {error}; its thread has ended")

    def _wait(self, until_s: float) -> None:
        """Wait until a command is due, or it is time to ask, or all is over."""
        with self._changed:
            while not self._closed:
                now_s = time.monotonic()
                next_s = min(until_s, self._waiting[0][0]) if self._waiting else until_s
                if next_s <= now_s:
                    return
                self._changed.wait(next_s - now_s)

    def _due(self) -> float | None:
        """The last of the commands that are due, or None."""
        opening_m = None
        with self._changed:
            while self._waiting and self._waiting[0][0] <= time.monotonic():
                opening_m = self._waiting.popleft()[1]
        return opening_m if opening_m is not None and self._may() else None

    def close(self) -> None:
        """End the connection. Nothing is sent: what is held stays held. May be called twice."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify()
        if self._thread is not threading.current_thread():
            self._thread.join()
        self._link.close()


class Grippers(Closing):
    """The grippers of both arms, as a cell file names them. Nothing is sent to them when this is made.

    Args:
        cell_file: Of the cell.
        force_n: Grip force, 20 to 235 N; a gripper at a digital output has its own.
        may: Asked, in a thread, when a command is due: whether it still holds. After a stop it does not.

    Attributes:
        each: The left and the right arm's; None where there is none.

    Raises:
        SettingsError: The force is not legal.
        LinkError: A gripper cannot be reached. None is connected then.
    """

    def __init__(self, cell_file: CellFile, *, force_n: float = 60.0, may: Callable[[], bool] = lambda: True) -> None:
        self.each: list[GripperThread | None] = []
        try:
            for name, arm in zip(ARMS, cell_file.arms, strict=True):
                link = link_to(arm, force_n, name)
                self.each.append(None if link is None else _started(name, link, may))
        except BaseException:
            self.close()
            raise

    @property
    def opening_m(self) -> tuple[float | None, float | None]:
        """Openings that were measured last; None where there is no gripper, or none that tells."""
        left, right = (None if each is None else each.opening_m for each in self.each)
        return left, right

    @property
    def fault(self) -> str:
        """Why one of them would not do what it is told, or "". It does not wait."""
        return self.fault_but()

    def fault_but(self, held: str | None = None) -> str:
        """The same, without what an arm's gripper has that is not used: "left" or "right"; None: both are."""
        used = [each for each in self.each if each is not None and each.name != held]
        return "; ".join(text for each in used if (text := each.fault))

    def command(self, openings_m: Sequence[float | None], at_s: float) -> None:
        """Open or close both at a time; see `GripperThread.command`. It does not wait.

        Args:
            openings_m: (2,) of the left and the right arm; None leaves that one as it is.
            at_s: When, on the clock of `time.monotonic`.

        Raises:
            ActionError: That is no opening that one of them has, or no time.
            ClosedError: They were closed.
        """
        for each, opening_m in zip(self.each, openings_m, strict=True):
            if each is not None and opening_m is not None:
                each.command(float(opening_m), at_s)

    def forget(self) -> None:
        """Somebody else may have moved them: the next commands are sent in any case.

        Raises:
            LinkError: One was lost.
        """
        for each in self.each:
            if each is not None:
                each.forget()

    def activate(
        self, confirm: Callable[[str], bool], within_s: float = ACTIVATION_S, *, held: str | None = None
    ) -> None:
        """Activate those that need it, one after the other, if a person agrees. It waits for the end.

        Grippers that are active already are left alone: what they hold stays held.

        Args:
            confirm: Shows the question to a person, and says whether the answer was yes. It is called once for each
                gripper that needs it, and not at all if none does.
            within_s: For each of them.
            held: "left" or "right": of that arm, which is not to move, the gripper is left as it is.

        Raises:
            OperationRefusedError: The person did not agree.
            LinkError: One was lost, or did not become active.
        """
        for each in self.each:
            if each is None or each.name == held or not each.needs_activation():
                continue
            question = (
                f"The {each.name} gripper is not active. Activation opens its fingers, and may close them before: keep "
                "hands away, and take out what it holds. Activate it?"
            )
            if confirm(question) is not True:
                raise OperationRefusedError(
                    f"the {each.name} gripper is not active, and its activation was not confirmed: it does not move. "
                    "Confirm it, or activate it at the pendant"
                )
            each.activate(within_s)

    def close(self) -> None:
        """End the connections. Nothing is sent: what is held stays held. May be called twice."""
        for each in self.each:
            if each is not None:
                each.close()


def link_to(arm: ArmEntry, force_n: float, name: str = "") -> GripperLink | None:
    """A connection to an arm's gripper, or None if there is none.

    Args:
        arm: Of the cell file.
        force_n: Of the grip; a gripper at a digital output has its own.
        name: Of the arm, for messages.

    Raises:
        SettingsError: The force is not legal.
        LinkError: The gripper cannot be reached.
    """
    if isinstance(arm.gripper, RobotiqSocket):
        return RobotiqLink(arm.host, arm.gripper.port, force_n, name=name)
    if isinstance(arm.gripper, DigitalGripper):
        return DigitalGripperLink(arm.host, arm.gripper, name=name)
    return None


def _started(name: str, link: GripperLink, may: Callable[[], bool]) -> GripperThread:
    try:
        return GripperThread(name, link, may=may)
    except BaseException:
        link.close()
        raise
