"""Grippers of a cell of controllers: a thread for each, so that no gripper delays the arms."""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar

from dual_ur10.errors import ActionError, ClosedError, DualUR10Error, LinkError, OperationRefusedError, SettingsError
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.cell_file.tables import ArmEntry, DigitalGripper, OwnGripper, RobotiqSocket, keywords_of
from dual_ur10.sim2real.peripherals.digital_gripper import DigitalGripperLink
from dual_ur10.sim2real.peripherals.gripper_link import (
    CheckedGripper,
    GripperLink,
    GripperRequest,
    RobotiqLink,
    check_drives,
)
from ur_core.kinematics.ur10 import ARMS
from ur_core.objects import load_object
from ur_core.processes.system import LOCAL, System
from ur_core.tools.tool import tool_named
from ur_core.types import Closing

log = logging.getLogger(__name__)

STALE_S: Final = 1.0
"""Largest age of a reading: each answer may take half a second."""

ACTIVATION_S: Final = 10.0
"""Time limit of an activation."""

_POLL_S: Final = 0.02
_MOST_WAITING: Final = 256  # commands; a quarter of a second ahead is 125 at most
_SLACK_M: Final = 1e-9

T = TypeVar("T")


class GripperThread:
    """Thread of one gripper. All methods but `activate` and `close` return at once.

    Args:
        name: Name of the arm.
        link: Link to the gripper; this object closes it.
        poll_s: Period of readings.
        permitted: Called in the thread when a command is due. The command is dropped if it returns False.
        system: Clock and threads.

    Raises:
        LinkError: There is no first reading.
    """

    def __init__(
        self,
        name: str,
        link: GripperLink,
        poll_s: float = _POLL_S,
        permitted: Callable[[], bool] = lambda: True,
        *,
        system: System = LOCAL,
    ) -> None:
        self.name, self._clock = name, system.clock
        self._link, self._poll_s, self._permitted = link, poll_s, permitted
        self._reading = link.read()
        self._read_s = self._clock.now_s()
        self._lost = ""
        self._closed = False
        self._waiting: deque[tuple[float, float]] = deque()
        self._waiting_lock = threading.Lock()  # never held while waiting
        self._link_lock = system.lock()  # taken for one call, or for an activation
        self._changed = system.event()
        self._thread = system.thread(self._run, f"{name} gripper")

    @property
    def opening_m(self) -> float | None:
        """Newest opening, 0 to the tool's stroke; None if unknown."""
        return self._reading.opening_m

    @property
    def fault(self) -> str:
        """Reason why it would not obey a command, with its arm, or "". A lost gripper stays lost."""
        if self._lost:
            return self._lost
        if self._reading.fault:
            return f"{self._link.where}: {self._reading.fault}"
        age_s = self._clock.now_s() - self._read_s
        if age_s > STALE_S and not self._closed:
            return f"{self._link.where}: not heard for {age_s:.1f} s; check the controller and the network"
        return ""

    def command(self, opening_m: float, at_s: float) -> None:
        """Open or close at a time. This drops commands for that time or later; of several due, the last is sent.

        Args:
            opening_m: Target distance of the fingers, 0 to the tool's stroke.
            at_s: Time on the system's clock; a time in the past means at once.

        Raises:
            ActionError: The opening is out of range, or the time not finite.
            ClosedError: It was closed.
        """
        stroke_m = self._link.tool.stroke_m
        if not (-_SLACK_M <= opening_m <= stroke_m + _SLACK_M and math.isfinite(at_s)):
            raise ActionError(
                f"the {self.name} gripper is to open to {opening_m!r} m at {at_s!r} s: allowed are 0 to {stroke_m} m, "
                "at a finite time"
            )
        if self._closed:
            raise ClosedError(f"the {self.name} gripper was closed: make another")
        with self._waiting_lock:
            while self._waiting and self._waiting[-1][0] >= at_s:
                self._waiting.pop()
            self._waiting.append((at_s, float(opening_m)))
            while len(self._waiting) > _MOST_WAITING:
                self._waiting.popleft()
        self._changed.set()

    def forget(self) -> None:
        """Send the next command in any case, since somebody else may have moved the gripper.

        Raises:
            LinkError: It was lost.
        """
        self._directly(self._link.forget)

    def needs_activation(self) -> bool:
        """Ask it whether it must be activated before it accepts commands. This waits for the answer.

        Raises:
            LinkError: It was lost.
        """
        return self._directly(self._link.needs_activation)

    def activate(self, within_s: float = ACTIVATION_S) -> None:
        """Activate it, and wait for the end. Its fingers open, and may close before; a held object falls.

        Waiting commands are dropped.

        Raises:
            LinkError: It was lost, or did not become active within the time.
        """

        def act() -> None:
            with self._waiting_lock:
                self._waiting.clear()
            self._link.activate(within_s)
            self._ask()

        self._directly(act)

    def _directly(self, act: Callable[[], T]) -> T:
        """Call `act` between two calls of the thread."""
        with self._link_lock:
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
        self._read_s = self._clock.now_s()

    def _lose(self, text: str) -> None:
        self._lost = text
        log.error("%s", text)
        self._link.close()

    def _run(self) -> None:
        next_s = self._clock.now_s()
        while True:
            self._wait(next_s)
            with self._link_lock:
                if self._closed or self._lost:
                    return
                try:
                    opening_m = self._due()  # with the lock: an activation may just have dropped it
                    if opening_m is not None:
                        self._link.command(opening_m)
                    if self._clock.now_s() >= next_s:
                        self._ask()
                        next_s = self._clock.now_s() + self._poll_s
                except DualUR10Error as error:
                    self._lose(str(error))
                except Exception as error:  # of any kind: the program must learn of it
                    self._lose(f"{self._link.where}: {type(error).__name__}: {error}; its thread has ended")

    def _wait(self, until_s: float) -> None:
        """Wait until a command or a reading is due, or this was closed."""
        while not self._closed:
            self._changed.clear()
            now_s = self._clock.now_s()
            with self._waiting_lock:
                next_s = min(until_s, self._waiting[0][0]) if self._waiting else until_s
            if next_s <= now_s or self._closed:
                return
            self._changed.wait(next_s - now_s)

    def _due(self) -> float | None:
        """Return the last of the due commands, or None."""
        opening_m = None
        with self._waiting_lock:
            while self._waiting and self._waiting[0][0] <= self._clock.now_s():
                opening_m = self._waiting.popleft()[1]
        return opening_m if opening_m is not None and self._permitted() else None

    def close(self) -> None:
        """End the connection. Nothing is sent: a held object stays held. May be called twice."""
        self._closed = True
        with self._waiting_lock:
            self._waiting.clear()
        self._changed.set()
        self._thread.join()
        self._link.close()


class Grippers(Closing):
    """Grippers of both arms, as a cell file names them. Making this object sends nothing to them.

    Args:
        cell_file: Cell file.
        force_n: Grip force, within that of both tools; a gripper at a digital output has its own.
        permitted: See `GripperThread`. After a stop, no command is permitted.
        system: Clock, network and threads.

    Attributes:
        each: Grippers of the left and the right arm; None where there is none.

    Raises:
        SettingsError: The force is not legal.
        LinkError: A gripper cannot be reached. None is connected then.
    """

    def __init__(
        self,
        cell_file: CellFile,
        *,
        force_n: float = 60.0,
        permitted: Callable[[], bool] = lambda: True,
        system: System = LOCAL,
    ) -> None:
        self.each: list[GripperThread | None] = []
        with self.closed_on_error():
            for name, arm in zip(ARMS, cell_file.arms, strict=True):
                link = link_to(arm, force_n, name, system)
                if link is None:
                    self.each.append(None)
                    continue
                with link.closed_on_error():
                    self.each.append(GripperThread(name, link, permitted=permitted, system=system))

    @property
    def opening_m(self) -> tuple[float | None, float | None]:
        """Newest openings; None where there is no gripper, or its opening is unknown."""
        left, right = (None if each is None else each.opening_m for each in self.each)
        return left, right

    @property
    def fault(self) -> str:
        """Reason why one of them would not obey a command, or "". It does not wait."""
        return self.fault_except()

    def fault_except(self, held: str | None = None) -> str:
        """Return the same, without the gripper of an arm that is not used: "left" or "right"; None: both are used."""
        used = [each for each in self.each if each is not None and each.name != held]
        return "; ".join(text for each in used if (text := each.fault))

    def command(self, openings_m: Sequence[float | None], at_s: float) -> None:
        """Open or close both; see `GripperThread.command`. It does not wait.

        Args:
            openings_m: (2,) left and right opening; None leaves that gripper as it is.
            at_s: Time on the system's clock.

        Raises:
            ActionError: An opening is out of range, or the time not finite.
            ClosedError: They were closed.
        """
        for each, opening_m in zip(self.each, openings_m, strict=True):
            if each is not None and opening_m is not None:
                each.command(float(opening_m), at_s)

    def forget(self) -> None:
        """Send the next commands in any case, since somebody else may have moved the grippers.

        Raises:
            LinkError: One was lost.
        """
        for each in self.each:
            if each is not None:
                each.forget()

    def activate(
        self, confirm: Callable[[str], bool], within_s: float = ACTIVATION_S, *, held: str | None = None
    ) -> None:
        """Activate those that need it, one after the other, with the operator's confirmation. It waits for the end.

        Active grippers are left alone: a held object stays held.

        Args:
            confirm: Asks the operator, and returns True for yes. It is called once for each gripper that needs
                activation.
            within_s: Time limit of each activation.
            held: "left" or "right": arm that is not to move, and whose gripper is left as it is.

        Raises:
            OperationRefusedError: The operator did not confirm it.
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
        """End the connections. Nothing is sent: a held object stays held. May be called twice."""
        for each in self.each:
            if each is not None:
                each.close()


def link_to(arm: ArmEntry, force_n: float, name: str = "", system: System = LOCAL) -> GripperLink | None:
    """Return a link to an arm's gripper, or None if there is none.

    Args:
        arm: Entry of the cell file.
        force_n: Grip force; a gripper at a digital output has its own.
        name: Name of the arm, for messages.
        system: Clock, network and threads.

    Raises:
        SettingsError: The force is not legal, or a driver of one's own cannot be made, or does not fit the tool.
        LinkError: The gripper cannot be reached.
    """
    if isinstance(arm.gripper, RobotiqSocket):
        tool = tool_named(arm.gripper.tool)
        return RobotiqLink(arm.host, arm.gripper.port, force_n, name=name, system=system, tool=tool)
    if isinstance(arm.gripper, DigitalGripper):
        return DigitalGripperLink(arm.host, arm.gripper, name=name, system=system)
    if isinstance(arm.gripper, OwnGripper):
        request = GripperRequest(
            arm=name, host=arm.host, tool=tool_named(arm.gripper.tool), force_n=force_n, system=system
        )
        return _own_link(arm.gripper, request)
    return None


def _own_link(entry: OwnGripper, request: GripperRequest) -> GripperLink:
    where = f"{request.arm} gripper: the driver {entry.driver}"
    driver: Any = load_object(entry.driver, f"the driver of the {request.arm} gripper")
    if not (isinstance(driver, type) and issubclass(driver, GripperLink)):
        raise SettingsError(f"{where} is no subclass of {GripperLink.__qualname__}: derive it from that class")
    check_drives(driver, request.tool, where)
    try:
        link: GripperLink = driver(request, **keywords_of(entry.options))  # type: ignore[call-arg]  # its own
    except TypeError as error:
        raise SettingsError(
            f"{where} cannot be made of a request and the options {entry.options or '(none)'}: {error}"
        ) from error
    except DualUR10Error:
        raise
    except Exception as error:  # of any kind: it is another's code
        raise LinkError(f"{where}: {error!r}") from error
    return CheckedGripper(link, request.tool, where)
