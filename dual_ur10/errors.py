"""Every exception this package raises on purpose.

All derive from [DualUR10Error][dual_ur10.errors.DualUR10Error]. A message says what was found, what is allowed and
what to do. Each also derives from the built-in exception a caller would expect (``ValueError`` for a bad value, ...),
so that generic handlers work too.
"""

from __future__ import annotations


class DualUR10Error(Exception):
    """Base of all errors of this package."""


class SettingsError(DualUR10Error, ValueError):
    """A setting (keyword, cell, profile or limit) is not legal."""


class UnknownNameError(DualUR10Error, ValueError):
    """A name (keyword, id, policy, camera, ...) is not one of those that exist."""

    def __init__(self, kind: str, found: str, allowed: tuple[str, ...] | list[str]) -> None:
        super().__init__(f"unknown {kind} {found!r}: use one of {', '.join(map(repr, allowed))}")
        self.kind, self.found, self.allowed = kind, found, tuple(allowed)

    def __reduce__(self) -> tuple[type, tuple[str, str, tuple[str, ...]]]:
        return type(self), (self.kind, self.found, self.allowed)


class ActionError(DualUR10Error, ValueError):
    """An action has the wrong shape or type, or holds NaN or infinity."""


class RateError(SettingsError):
    """A policy rate is no whole number of controller ticks, or a timestep does not divide the tick."""


class WorkspaceError(SettingsError):
    """A task asks for poses or speeds that the arms cannot reach."""


class CollisionAtStartError(SettingsError):
    """The arms are in contact, or closer than the safety gate allows, in the posture they would start from."""


class UnreachableError(DualUR10Error, ValueError):
    """A flange pose has no inverse kinematics solution inside the joint range."""


class LostError(DualUR10Error, RuntimeError):
    """A scripted policy that teaches does not know how to go on from where its pupil has led the arms."""


class ClosedError(DualUR10Error, RuntimeError):
    """The object was closed and cannot be used any more."""


class ResetNeededError(DualUR10Error, RuntimeError):
    """A step was asked for before the first reset."""


class ResetRefusedError(SettingsError):
    """A reset would move the arms of two controllers, and nobody has consented to that."""


class MissingExtraError(DualUR10Error, ImportError):
    """An optional dependency is not installed."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(f'{purpose} needs {package}: pip install "dual-ur10[{extra}]"')


class RenderError(DualUR10Error, RuntimeError):
    """No OpenGL backend was found for drawing."""


class ScriptError(DualUR10Error, ValueError):
    """A URScript program cannot be read, or failed while it ran.

    Attributes:
        line: Line of the program text, from 1.
        word: What the controller stopped at.
        reason: What is wrong with it.
    """

    def __init__(self, line: int, word: str, reason: str) -> None:
        super().__init__(f"line {line}, {word!r}: {reason}")
        self.line, self.word, self.reason = line, word, reason

    def __reduce__(self) -> tuple[type, tuple[int, str, str]]:
        return type(self), (self.line, self.word, self.reason)


class ScriptSyntaxError(ScriptError):
    """A URScript program does not follow the grammar, or uses a name that does not exist."""


class ScriptRuntimeError(ScriptError):
    """A URScript program did something that a controller stops it for."""


class MotionError(DualUR10Error, ValueError):
    """A motion command's arguments make no sense: a wrong length, NaN, a negative time."""


class ProtocolError(DualUR10Error, ValueError):
    """A client sent what no client of this protocol sends: its connection is closed."""


class OperationRefusedError(DualUR10Error, RuntimeError):
    """A controller refuses what it was asked to do in the state it is in."""


class AddressError(DualUR10Error, OSError):
    """An address cannot be used: it is taken, does not exist on this machine, or is not of the loopback interface."""


class EmulatorError(DualUR10Error, RuntimeError):
    """The emulated cell did not start, or ended."""


class CellFileError(SettingsError):
    """A cell file cannot be read, or says something that is not legal."""


class LinkError(DualUR10Error, ConnectionError):
    """A controller cannot be reached, does not answer as one, or has fallen silent."""


class RecordingError(DualUR10Error, ValueError):
    """A recording cannot be written or read, or is not of this robot, rate or task."""


class CellFaulted(DualUR10Error, RuntimeError):  # noqa: N818  # the name by which the project's users know it
    """Both arms were stopped, and stay so until a person has looked and has said `cell clear`."""


class CellBusyError(DualUR10Error, RuntimeError):
    """Another program moves these arms."""


class StartError(DualUR10Error, RuntimeError):
    """The arms are not ready to begin, cannot be brought to where a task begins, or nobody has confirmed it."""


class PolicyError(DualUR10Error, ValueError):
    """A policy does what no policy may do, as `dual_ur10.testing.check_policy` has found."""


class CheckpointError(DualUR10Error, ValueError):
    """A checkpoint cannot be written or read, is not as it was saved, or was made for another environment."""


class TrainingError(DualUR10Error, RuntimeError):
    """A training cannot be begun, gone on with or saved. What it has saved before is as it was."""


class DatasetError(DualUR10Error, ValueError):
    """A dataset cannot be made or read, or is not of this environment."""
