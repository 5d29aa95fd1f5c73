"""Exceptions of the package.

All derive from [DualUR10Error][dual_ur10.errors.DualUR10Error], and most also from the built-in exception that a
generic handler expects (``ValueError`` for a bad value, ...). A message names what was found, what is allowed and
what to do.
"""

from __future__ import annotations

import difflib
import re
import sys
from collections.abc import Sequence

_MOST_DECIMALS = 17
_NEWEST_OF_UR_RTDE = 3, 12  # Python for which ur_rtde 1.6.5 has wheels


def distinguishable(found: float, allowed: float, decimals: int = 3) -> tuple[str, str]:
    """Return two numbers with some decimals, or as many more as show that they differ, and that neither is 0."""
    texts = f"{found:.{decimals}f}", f"{allowed:.{decimals}f}"
    as_zero = [value != 0.0 == float(text) for value, text in zip((found, allowed), texts, strict=True)]
    hidden = texts[0] == texts[1] or any(as_zero)
    return distinguishable(found, allowed, decimals + 1) if hidden and decimals < _MOST_DECIMALS else texts


class DualUR10Error(Exception):
    """Base class of all errors of this package; raised itself when a file cannot be written."""


class SettingsError(DualUR10Error, ValueError):
    """Raised when a setting (keyword, cell, profile, limit or option) is not legal, or does not fit another one."""


_MOST_COMPARED = 100  # characters; the time of a comparison grows with their square
_NEAR = 0.7  # ratio of equal characters
_LEAST_PART = 4  # characters by which a longer name is found


def nearest_name(found: str, allowed: Sequence[str]) -> str:
    """Return the name that a misspelled or shortened one most resembles, with or without its namespace; "" if none.

    Upper and lower case are the same. A shortened name is part of one name alone.
    """
    if len(found) > _MOST_COMPARED:
        return ""
    forms = {form.casefold(): name for name in allowed for form in (name, name.rsplit("/", 1)[-1])}
    ratios = {form: difflib.SequenceMatcher(None, form, found.casefold()).ratio() for form in forms}
    near = max(ratios, key=lambda form: ratios[form], default="")  # of equally near ones the first
    if near and ratios[near] >= _NEAR:
        return forms[near]
    longer = {name for form, name in forms.items() if len(found) >= _LEAST_PART and found.casefold() in form}
    return longer.pop() if len(longer) == 1 else ""


class UnknownNameError(DualUR10Error, ValueError):
    """Raised when a name (keyword, id, policy, camera, ...) does not exist.

    Attributes:
        kind: Kind of name, such as "camera".
        found: The unknown name.
        allowed: Names that exist.
        other: Description of what else is allowed, such as "the path of a file"; "" for nothing.
    """

    def __init__(self, kind: str, found: str, allowed: Sequence[str], other: str = "") -> None:
        near = nearest_name(found, allowed)
        hint = f" (did you mean {near!r}?)" if near else ""
        ways = [*([f"one of {', '.join(map(repr, allowed))}"] if allowed else []), *([other] if other else [])]
        use = f"use {', or '.join(ways)}" if ways else "there is none"
        super().__init__(f"unknown {kind} {found!r}{hint}: {use}")
        self.kind, self.found, self.allowed, self.other = kind, found, tuple(allowed), other

    def __reduce__(self) -> tuple[type, tuple[str, str, tuple[str, ...], str]]:
        return type(self), (self.kind, self.found, self.allowed, self.other)


class UnknownKeywordError(UnknownNameError, TypeError):
    """Raised when an environment has no such keyword.

    It is a `TypeError` with Python's own words, too, because libraries find out by it which keywords an environment
    takes. Gymnasium raises it anew from its text alone, to which it appends all keywords: that part is left out.

    Args:
        text: Text of the error.
    """

    def __init__(self, text: str) -> None:
        Exception.__init__(self, text.split(" was raised from the environment creator", 1)[0])
        names = re.findall(r"'([^']*)'", str(self))
        self.kind, self.found, self.other = "keyword", names[0] if names else "", ""
        self.allowed = tuple(names[1:])

    @classmethod
    def of(cls, task: str, found: str, allowed: list[str]) -> UnknownKeywordError:
        """Return the error of a keyword that a task does not have."""
        near = nearest_name(found, allowed)
        hint = f" (did you mean {near}?)" if near else ""  # without quotes: the constructor collects the quoted names
        return cls(
            f"{task} got an unexpected keyword argument {found!r}{hint}: use one of {', '.join(map(repr, allowed))}"
        )

    def __reduce__(self) -> tuple[type, tuple[str]]:  # type: ignore[override]  # made of its text
        return type(self), (str(self),)


class ActionError(DualUR10Error, ValueError):
    """Raised when an action has the wrong shape or type, or holds NaN or infinity. Nothing has moved then."""


class RateError(SettingsError):
    """Raised when a period is not a whole number of controller ticks, or a timestep does not divide the tick."""


class WorkspaceError(SettingsError):
    """Raised when the settings of a task demand poses or speeds that the arms cannot reach."""


class TaskError(DualUR10Error, ValueError):
    """Raised when a task returns a start, an observation, a reward or an info that breaks the contract of tasks."""


class CollisionAtStartError(SettingsError):
    """Raised when the arms are in contact, or closer than the safety gate allows, in their start configuration."""


class UnreachableError(DualUR10Error, ValueError):
    """Raised when a flange pose has no inverse kinematics solution inside the joint range."""


class LostError(DualUR10Error, RuntimeError):
    """Raised when a scripted expert cannot continue from the state to which its learner has brought the arms."""


class ClosedError(DualUR10Error, RuntimeError):
    """Raised when an object is used after `close()`, or in a forked process to which it does not belong."""


class ResetNeededError(DualUR10Error, RuntimeError):
    """Raised when `step` is called before the first reset, or after an episode that terminated."""


class ResetRefusedError(SettingsError):
    """Raised when a reset would move the arms of two controllers without the consent of its caller."""


class MissingExtraError(DualUR10Error, ImportError):
    """Raised when optional dependencies are not installed; the message names all extras to install.

    Where a package has no wheels for this Python, it names those for which it has.

    Args:
        package: Package that is missing.
        extra: Extra that brings it.
        purpose: Noun for what needs it.
        others: Errors of other packages, which are part of this one.

    Attributes:
        needs: Texts of what needs which package.
        extras: Names of the extras.
    """

    def __init__(self, package: str, extra: str, purpose: str, others: Sequence[MissingExtraError] = ()) -> None:
        python = sys.version_info[:2]
        where = (
            f", which has wheels for Python 3.11 and 3.12 only, found {python[0]}.{python[1]}. There"
            if package == "ur_rtde" and python > _NEWEST_OF_UR_RTDE
            else ""
        )
        self.needs: tuple[str, ...] = (
            *(need for each in others for need in each.needs),
            f"{purpose} needs {package}{where}",
        )
        self.extras: tuple[str, ...] = tuple(dict.fromkeys((*(name for each in others for name in each.extras), extra)))
        super().__init__(f'{", and ".join(self.needs)}: pip install "dual-ur10[{",".join(self.extras)}]"')


class RenderError(DualUR10Error, RuntimeError):
    """Raised when no OpenGL backend was found, or a viewer cannot be shown."""


class ScriptError(DualUR10Error, ValueError):
    """Base class of the errors of a URScript program.

    Attributes:
        line: Line of the program text, from 1.
        word: Word at which the controller stopped.
        reason: Description of the error.
        column: Column at which the word begins, from 1.
    """

    def __init__(self, line: int, word: str, reason: str, column: int = 1) -> None:
        super().__init__(f"line {line}, {word!r}: {reason}")
        self.line, self.word, self.reason, self.column = line, word, reason, column

    def __reduce__(self) -> tuple[type, tuple[int, str, str, int]]:
        return type(self), (self.line, self.word, self.reason, self.column)


class ScriptSyntaxError(ScriptError):
    """Raised when a URScript program violates the grammar, or uses a name that does not exist."""


class ScriptNameError(ScriptSyntaxError):
    """Raised when a URScript program uses a name that is neither defined in it nor known to any controller."""


class ScriptRuntimeError(ScriptError):
    """Raised when a URScript program does something for which a controller stops it."""


class MotionError(DualUR10Error, ValueError):
    """Raised when the arguments of a motion command are invalid: a wrong length, NaN, a negative time."""


class ProtocolError(DualUR10Error, ValueError):
    """Raised when a peer violates a protocol; the connection is closed."""


class OperationRefusedError(DualUR10Error, RuntimeError):
    """Raised when a controller or gripper refuses a command in its present state."""


class AddressError(DualUR10Error, OSError):
    """Raised when an emulated controller cannot use an address: it is taken, unknown, or not a loopback address."""


class EmulatorError(DualUR10Error, RuntimeError):
    """Raised when an emulated cell did not start, or has ended."""


class CellFileError(SettingsError):
    """Raised when a cell file cannot be read, or holds a value that is not legal."""


class VirtualCellError(DualUR10Error, RuntimeError):
    """Raised when a virtual cell is asked for what only real processes show, or when none of its actors goes on."""


class LinkError(DualUR10Error, ConnectionError):
    """Raised when a controller, gripper or tracker cannot be reached, gives a wrong answer, or has fallen silent."""


class RecordingError(DualUR10Error, ValueError):
    """Raised when a recording cannot be written or read, or belongs to another robot, rate or task."""


class CellFaulted(DualUR10Error, RuntimeError):  # noqa: N818  # the established name
    """Raised when both arms have a latched stop, until an operator has checked them and run `cell clear`."""


class CellBusyError(DualUR10Error, RuntimeError):
    """Raised when another program controls these arms."""


class StartError(DualUR10Error, RuntimeError):
    """Raised when the arms are not ready, cannot move to the start of a task, or the operator has not confirmed it."""


class PlanningError(DualUR10Error, RuntimeError):
    """Raised when no collision-free path between two configurations of both arms exists, or none was found."""


class CalibrationError(DualUR10Error, ValueError):
    """Raised when observations of a calibration are invalid, do not determine the bases, or fit badly."""


class TrajectoryError(DualUR10Error, ValueError):
    """Raised when a trajectory or a goal of one is invalid. Nothing has moved then.

    Attributes:
        code: Result code with which a goal of it is rejected; see `ResultCode` of the trajectories.
    """

    def __init__(self, text: str, code: int = -1) -> None:
        super().__init__(text)
        self.code = code

    def __reduce__(self) -> tuple[type, tuple[str, int]]:
        return type(self), (str(self), self.code)


class PolicyError(DualUR10Error, ValueError):
    """Raised when an object is no policy, or `dual_ur10.testing.check_policy` finds a violation of the contract."""


class DeviceError(DualUR10Error, RuntimeError):
    """Base class of the errors of an input device with which a person leads the arms."""


class DeviceAbsentError(DeviceError):
    """Raised when an input device is not there, or what is there is another one."""


class DeviceDeniedError(DeviceError):
    """Raised when this user may not open an input device; the message holds the udev rule to add."""


class DeviceSharedError(DeviceError):
    """Raised when one input device is named for both arms, or another program reads it."""


class DeviceUnpluggedError(DeviceError):
    """Raised when an input device disappears while it is read."""


class DeviceSilentError(DeviceError):
    """Raised when an input device that must report has not done so for too long. The arms have stopped by then."""


class DeviceGarbageError(DeviceError):
    """Raised when an input device sends what cannot be understood."""


class StopPressedError(DeviceError):
    """Raised when a person presses the button "stop" of an input device. On two controllers it latches a stop."""


class LeaderConfigurationError(DeviceError):
    """Raised when the joints of a leader arm are too far from those of the arm that it is to lead."""


class CheckpointError(DualUR10Error, ValueError):
    """Raised when a checkpoint cannot be written or read, was altered, or belongs to another environment."""


class TrainingError(DualUR10Error, RuntimeError):
    """Raised when a training cannot be started, resumed or saved. Earlier saved states are intact."""


class DatasetError(DualUR10Error, ValueError):
    """Raised when a dataset cannot be made or read, or belongs to another environment."""


class KernelError(DualUR10Error, RuntimeError):
    """Raised when the compiled control kernel is missing or not that of its sources, or is given other data."""


def __dir__() -> list[str]:
    return sorted(name for name, each in globals().items() if isinstance(each, type) and issubclass(each, Exception))
