"""Operators by name, with the arguments of their devices and of their mapping in one text."""

from __future__ import annotations

import ast
import dataclasses
import importlib.metadata
import inspect
import re
import sys
import time
from collections.abc import Mapping as Values
from collections.abc import Sequence
from typing import Any, Final

from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import DualUR10Error, SettingsError, UnknownNameError
from dual_ur10.policies.operators.device import Device
from dual_ur10.policies.operators.keyboard import Keyboard, WithKeys
from dual_ur10.policies.operators.mapping import Mapping
from dual_ur10.policies.operators.operator import Operator
from dual_ur10.policies.operators.page import PageDevice
from dual_ur10.policies.registry import arguments_of
from ur_core.objects import load_object

_HERE: Final = "dual_ur10.policies.operators"

DEVICES: Final = {
    "keyboard": f"{_HERE}.keyboard:Keyboard",
    "gamepad": f"{_HERE}.gamepad:Gamepad",
    "spacemouse": f"{_HERE}.spacemouse:SpaceMouse",
    "leader": f"{_HERE}.leader:Leader",
    "page": f"{_HERE}.page:page_device",
}
"""Classes of devices of this package, or functions that make them, "module:Class", by name."""

GROUP: Final = "dual_ur10.devices"
"""Entry-point group of installed packages: name of a device, and where its class is."""

_EXTRAS: Final = {
    "gamepad": ("teleop", "a gamepad"),
    "leader": ("teleop", "a leader arm"),
    "page": ("live", "the live page"),
}

_OWN: Final = re.compile(r"([^\W\d][\w.]*:[^\W\d]\w*)(?::(.*))?", re.DOTALL)
_OF_MAPPING: Final = tuple(each.name for each in dataclasses.fields(Mapping))
_NOT_TEXT: Final = ("clock", "file", "setup", "acts_on")  # arguments of devices that only programs give


def device_class(text: str) -> tuple[str, str]:
    """Return the class of a device, "module:Class", and the text of its arguments.

    Args:
        text: "NAME", "NAME:ARGUMENTS", "module:Class" or "module:Class:ARGUMENTS".

    Raises:
        UnknownNameError: There is no such device.
    """
    name, _, rest = text.partition(":")
    if name in DEVICES:
        return DEVICES[name], rest
    devices = installed()
    if name in devices:
        return devices[name], rest
    own = _OWN.fullmatch(text)
    if own is None:
        raise UnknownNameError("operator", text, tuple(devices), "module:Class of a device of your own")
    return own[1], own[2] or ""


def installed() -> dict[str, str]:
    """Return the devices of this package and of installed ones, "module:Class", by name."""
    found = {each.name: each.value for each in importlib.metadata.entry_points(group=GROUP)}
    return {**DEVICES, **{name: path for name, path in found.items() if name not in DEVICES}}


def extra_of(text: str) -> tuple[str, str] | None:
    """Return the extra that a device needs and a noun for it; None: it needs none.

    Args:
        text: As for `device_class`.

    Raises:
        SettingsError: An argument has another form.
    """
    name, _, rest = text.partition(":")
    if name == "keyboard" and arguments_in(rest).get("window") is True:
        return "teleop", "a keyboard's window"
    return _EXTRAS.get(name)


def arguments_in(text: str) -> dict[str, Any]:
    """Return the arguments of a text, "KEY=VALUE,KEY=VALUE": numbers, True and False, texts, and tuples with "/".

    Raises:
        SettingsError: A part has another form, or a key is given twice.
    """
    found: dict[str, Any] = {}
    for part in filter(None, text.split(",")):
        key, sign, value = part.partition("=")
        if not sign or not key.strip().isidentifier():
            raise SettingsError(f"operator argument {part!r}: write it as KEY=VALUE, such as left=/dev/hidraw3")
        if key.strip() in found:
            raise SettingsError(f"operator argument {key.strip()} is given twice")
        found[key.strip()] = _value(value.strip())
    return found


def _value(text: str) -> Any:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    if "/" in text and not text.startswith("/"):
        parts = [_number(each) for each in text.split("/")]
        if all(isinstance(each, int | float) for each in parts):
            return tuple(parts)
    return _number(text)


def _number(text: str) -> Any:
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text
    return value if isinstance(value, int | float) else text


def make_device(text: str, setup: EnvSetup | None = None, buttons: Sequence[str] = ()) -> tuple[Device, Mapping]:
    """Return a device, opened, and the mapping of its operator.

    Args:
        text: As for `device_class`. Arguments are those of the device's class and of `Mapping`.
        setup: The environment, for a class that takes it as its argument `setup`.
        buttons: Names of buttons that the program acts on, for a class that takes them as its argument `acts_on`.

    Raises:
        UnknownNameError: There is no such device or argument.
        SettingsError: A value is not legal, or a class cannot be imported or made.
        DeviceError: One of its kinds: the device cannot be opened.
        MissingExtraError: It needs a package that is not installed.
    """
    path, rest = device_class(text)
    factory = load_object(path, "the operator's device", registered=path in installed().values())
    given = arguments_in(rest)
    mapping = Mapping(**{name: given.pop(name) for name in _OF_MAPPING if name in given})
    try:
        taken = inspect.signature(factory).parameters
        known = [name for name in taken if name not in _NOT_TEXT]
        unknown = next((name for name in given if name not in known), None)
        if unknown is not None:
            raise UnknownNameError(f"argument of the operator {text.split(':')[0]}", unknown, [*known, *_OF_MAPPING])
        context = {"setup": setup, "acts_on": tuple(buttons)}
        return factory(**given, **{name: value for name, value in context.items() if name in taken}), mapping
    except DualUR10Error:
        raise
    except (TypeError, ValueError) as error:
        raise SettingsError(f"the operator's device {text!r} cannot be made: {error}") from error


def operator_with(
    device: Device, setup: EnvSetup, mapping: Mapping | None = None, *, paced: bool = False, keys: bool = False
) -> Operator:
    """Return the operator of an environment with a device.

    Args:
        device: The device.
        setup: The environment.
        mapping: Settings between hands and arms.
        paced: Let actions wait for the time of day where steps are faster than a person can follow.
        keys: Read the buttons from the keyboard of the terminal, too, if there is one and the device has none for them.

    Raises:
        SettingsError: It is no device.
    """
    names = ("timing", "action_mode", "action_scale", "mounts", "limits", "tools", "grippers")
    view = setup.make_task().concise_view() if setup.options.concise else None
    clock = time.monotonic if paced and not setup.keeps_time else None
    try:
        if keys and isinstance(device, Device) and not isinstance(device, Keyboard | PageDevice) and _is_terminal():
            device = WithKeys(device, Keyboard())
        return Operator(device, mapping, clock=clock, view=view, **arguments_of(setup, names))
    except BaseException:
        if isinstance(device, Device):
            device.close()
        raise


def load_operator(
    text: str,
    env_id: str,
    keywords: Values[str, Any],
    *,
    paced: bool = False,
    keys: bool = False,
    buttons: Sequence[str] = (),
) -> Operator:
    """Return the operator of an environment with these keywords.

    Args:
        text: As for `make_device`.
        env_id: Id of the environment.
        keywords: Keywords of the environment.
        paced: As for `operator_with`.
        keys: As for `operator_with`.
        buttons: As for `make_device`.

    Raises:
        DualUR10Error: As for `make_device`, or a keyword is not legal.
    """
    setup = EnvSetup.resolve(env_id, keywords, ignore_unknown=True)
    device, mapping = make_device(text, setup, buttons)
    return operator_with(device, setup, mapping, paced=paced, keys=keys)


def _is_terminal() -> bool:
    return sys.stdin is not None and sys.stdin.isatty()
