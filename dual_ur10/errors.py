"""Exceptions of the package.

All derive from [DualUR10Error][dual_ur10.errors.DualUR10Error], and most also from the built-in exception that a
generic handler expects (``ValueError`` for a bad value, ...). A message names what was found, what is allowed and
what to do. Those of arms, links and protocols are of `ur_core.errors`, and are found here, too.
"""

from __future__ import annotations

import re

from ur_core.errors import (
    AddressError as AddressError,
)
from ur_core.errors import (
    ClosedError as ClosedError,
)
from ur_core.errors import (
    EmulatorError as EmulatorError,
)
from ur_core.errors import (
    KernelError as KernelError,
)
from ur_core.errors import (
    LinkError as LinkError,
)
from ur_core.errors import (
    MissingExtraError as MissingExtraError,
)
from ur_core.errors import (
    MotionError as MotionError,
)
from ur_core.errors import (
    OperationRefusedError as OperationRefusedError,
)
from ur_core.errors import (
    ProtocolError as ProtocolError,
)
from ur_core.errors import (
    RateError as RateError,
)
from ur_core.errors import (
    RenderError as RenderError,
)
from ur_core.errors import (
    ScriptError as ScriptError,
)
from ur_core.errors import (
    ScriptNameError as ScriptNameError,
)
from ur_core.errors import (
    ScriptRuntimeError as ScriptRuntimeError,
)
from ur_core.errors import (
    ScriptSyntaxError as ScriptSyntaxError,
)
from ur_core.errors import (
    SettingsError as SettingsError,
)
from ur_core.errors import (
    UnknownNameError as UnknownNameError,
)
from ur_core.errors import (
    UnreachableError as UnreachableError,
)
from ur_core.errors import (
    URError,
)
from ur_core.errors import (
    VirtualCellError as VirtualCellError,
)
from ur_core.errors import (
    distinguishable as distinguishable,
)
from ur_core.errors import (
    nearest_name as nearest_name,
)

DualUR10Error = URError
"""Base class of all errors."""


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
    """Raised when an action has the wrong shape or type, holds NaN or infinity, or would move an arm that is held.

    Nothing has moved then.
    """


class WorkspaceError(SettingsError):
    """Raised when the settings of a task demand poses or speeds that the arms cannot reach."""


class TaskError(DualUR10Error, ValueError):
    """Raised when a task returns a start, an observation, a reward or an info that breaks the contract of tasks."""


class CollisionAtStartError(SettingsError):
    """Raised when the arms are in contact, or closer than the safety gate allows, in their start configuration."""


class LostError(DualUR10Error, RuntimeError):
    """Raised when a scripted expert cannot continue from the state to which its learner has brought the arms."""


class ResetNeededError(DualUR10Error, RuntimeError):
    """Raised when `step` is called before the first reset, or after an episode that terminated."""


class ResetRefusedError(SettingsError):
    """Raised when a reset would move the arms of two controllers without the consent of its caller."""


class CellFileError(SettingsError):
    """Raised when a cell file cannot be read, or holds a value that is not legal."""


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


class ChunkError(PolicyError):
    """Raised when a chunk policy returns something else than a chunk of actions, or nothing. Arms have come to rest."""


class PolicyServerError(DualUR10Error, RuntimeError):
    """Raised when a policy server is not there, is gone, does not answer, or answers with something else."""


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


def __dir__() -> list[str]:
    return sorted(name for name, each in globals().items() if isinstance(each, type) and issubclass(each, Exception))
