"""Exceptions of the arms: names, settings, links and protocols.

All derive from [URError][ur_core.errors.URError], and most also from the built-in exception that a generic handler
expects (``ValueError`` for a bad value, ...). A message names what was found, what is allowed and what to do.
"""

from __future__ import annotations

import difflib
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


class URError(Exception):
    """Base class of all errors; raised itself when a file cannot be written."""


class SettingsError(URError, ValueError):
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


class UnknownNameError(URError, ValueError):
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


class RateError(SettingsError):
    """Raised when a period is not a whole number of controller ticks, or a timestep does not divide the tick."""


class UnreachableError(URError, ValueError):
    """Raised when a flange pose has no inverse kinematics solution inside the joint range."""


class ClosedError(URError, RuntimeError):
    """Raised when an object is used after `close()`, or in a forked process to which it does not belong."""


class MissingExtraError(URError, ImportError):
    """Raised when optional dependencies are not installed; the message names all extras to install.

    Where a package has no wheels for this Python, it names those for which it has.

    Args:
        package: Package that is missing.
        extra: Extra that brings it.
        purpose: Noun for what needs it.
        others: Errors of other packages, which are part of this one.
        distribution: Distribution that has the extra.

    Attributes:
        needs: Texts of what needs which package.
        extras: Names of the extras by their distribution.
    """

    def __init__(
        self,
        package: str,
        extra: str,
        purpose: str,
        others: Sequence[MissingExtraError] = (),
        *,
        distribution: str = "dual-ur10",
    ) -> None:
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
        self.extras: dict[str, tuple[str, ...]] = {}
        found = [pair for each in others for pair in each.extras.items()]
        for name, extras in (*found, (distribution, (extra,))):
            self.extras[name] = tuple(dict.fromkeys((*self.extras.get(name, ()), *extras)))
        wanted = " ".join(f'"{name}[{",".join(extras)}]"' for name, extras in self.extras.items())
        super().__init__(f"{', and '.join(self.needs)}: pip install {wanted}")


class MixedVersionsError(URError, ImportError):
    """Raised when distributions of different versions are installed together.

    Args:
        distribution: Distribution that is imported.
        version: Its version.
        needed: Distribution that it needs, in the same version.
        found: Version of that one.
    """

    def __init__(self, distribution: str, version: str, needed: str, found: str) -> None:
        super().__init__(
            f"{distribution} {version} needs {needed} {version}, found {found}: "
            f'pip install "{distribution}=={version}" "{needed}=={version}"'
        )


class RenderError(URError, RuntimeError):
    """Raised when no OpenGL backend was found, or a viewer cannot be shown."""


class ScriptError(URError, ValueError):
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


class ProtocolError(URError, ValueError):
    """Raised when a peer violates a protocol; the connection is closed."""


class OperationRefusedError(URError, RuntimeError):
    """Raised when a controller or gripper refuses a command in its present state."""


class AddressError(URError, OSError):
    """Raised when an emulated controller cannot use an address: it is taken, unknown, or not a loopback address."""


class LinkError(URError, ConnectionError):
    """Raised when a controller, gripper or tracker cannot be reached, gives a wrong answer, or has fallen silent."""


class MotionError(URError, ValueError):
    """Raised when the arguments of a motion command are invalid: a wrong length, NaN, a negative time."""


class EmulatorError(URError, RuntimeError):
    """Raised when an emulated cell did not start, or has ended."""


class VirtualCellError(URError, RuntimeError):
    """Raised when a virtual cell is asked for what only real processes show, or when none of its actors goes on."""


class KernelError(URError, RuntimeError):
    """Raised when the compiled control kernel is missing or not that of its sources, or is given other data."""
