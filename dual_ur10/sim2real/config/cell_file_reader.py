"""Checks of what a cell file says: first each key by itself, then what fits together."""

from __future__ import annotations

import difflib
import ipaddress
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from dual_ur10.assets.settings import SceneSettings
from dual_ur10.errors import SettingsError
from dual_ur10.kinematics.frames import ArmMount
from dual_ur10.kinematics.ur10 import ARMS, DHParameters
from dual_ur10.sim2real.config.cell import LEAST_DAMPING
from dual_ur10.sim2real.config.cell_file_keys import Key, Table
from dual_ur10.sim2real.config.cell_file_schema import CELL, MOST_OBSTACLES, rows
from dual_ur10.sim2real.control.servoj import ServojProfile

_SHOWN: Final = 60  # characters of a value that a message shows
_DEPTH: Final = 3  # and brackets inside brackets
_UNIT_TOLERANCE: Final = 1e-3
_BEHIND_M: Final = 0.01
_CALIBRATION: Final = ("a_m", "d_m", "alpha_rad", "theta_rad")


def read(mapping: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Check the content of a file.

    Returns:
        All values, with defaults for what is missing, None where there is none; and what is wrong, a line each. With
        anything wrong, the values are not to be used.
    """
    reader = _Reader(real=mapping.get("kind") == "real")
    values = reader.table(mapping, CELL, "")
    # What fits together is only looked at when each value is what it should be.
    return values, reader.findings or list(_rules(values))


class _Reader:
    """Checks each key by itself.

    Args:
        real: Whether the file is that of a real cell, which has to say more.
    """

    def __init__(self, real: bool) -> None:
        self.real = real
        self.findings: list[str] = []

    def table(self, found: Any, table: Table, path: str) -> dict[str, Any]:
        if not isinstance(found, Mapping):
            self._wrong(path, found, "a table", f"Write it as [{path}]")
            return {}
        keys, known = list(table.keys), True
        if table.variants:
            chosen = found.get("kind", table.keys[-1].default)
            known = isinstance(chosen, str) and chosen in table.variants
            keys += table.variants[chosen] if known else []
        names = [each.name for each in keys] + [each.name for each in table.tables]
        for name in found:
            if name not in names and (
                known or not any(name == key.name for row in table.variants.values() for key in row)
            ):
                self._unknown(str(name), names, table, path)
        values = {key.name: self._value(found, key, _join(path, key.name)) for key in keys}
        for inner in table.tables:
            values[inner.name] = self._inner(found, inner, _join(path, inner.name))
        return values

    def _inner(self, found: Mapping[str, Any], table: Table, path: str) -> Any:
        if table.name not in found:
            if table.required:
                self.findings.append(f"{path} is missing: a cell has two arms. Add a table [{path}]")
                return {}
            if table.many:
                return ()
            return None if table.optional else self.table({}, table, path)
        value = found[table.name]
        if not table.many:
            return self.table(value, table, path)
        if not isinstance(value, list | tuple) or len(value) > MOST_OBSTACLES:
            found_ = f"{len(value)} tables" if isinstance(value, list | tuple) else _shown(value)
            allowed = f"an array of at most {MOST_OBSTACLES} tables"
            self.findings.append(f"{path} is {found_}: allowed is {allowed}. Write each as [[{path}]]")
            return ()
        return tuple(self.table(each, table, f"{path}[{row}]") for row, each in enumerate(value))

    def _value(self, found: Mapping[str, Any], key: Key, path: str) -> Any:
        if key.name not in found:
            if key.required == "always" or (key.required == "real" and self.real):
                why = "the file of a real cell has to say it" if key.required == "real" else "it has to be there"
                self.findings.append(f"{path} is missing: {why}. Add a line such as {key.sample} ({key.allowed})")
            return key.default
        value = found[key.name]
        if not key.count:
            return self._single(value, key, path)
        if not isinstance(value, list | tuple) or len(value) != key.count:
            self._wrong(path, value, key.allowed, f"Write {key.count} of them in brackets, as in {key.sample}")
            return None
        return tuple(self._single(each, key, f"{path}[{row}]") for row, each in enumerate(value))

    def _single(self, value: Any, key: Key, path: str) -> Any:
        legal = {
            "number": isinstance(value, int | float) and not isinstance(value, bool),
            "integer": isinstance(value, int) and not isinstance(value, bool),
            "text": isinstance(value, str),
            "switch": isinstance(value, bool),
        }[key.type]
        if legal and key.type in ("number", "integer"):
            legal = key.low <= value <= key.high  # NaN is in no range
        if legal and key.type == "text":
            legal = _text_is_legal(value, key)
        if not legal:
            self._wrong(path, value, key.allowed, f"Write it as in {key.sample}")
            return None
        # Without the sign of zero: equal files are to have equal texts.
        return float(value) + 0.0 if key.type == "number" else value

    def _wrong(self, path: str, found: Any, allowed: str, remedy: str) -> None:
        self.findings.append(f"{path} is {_shown(found)}: allowed is {allowed}. {remedy}")

    def _unknown(self, name: str, names: list[str], table: Table, path: str) -> None:
        place = f"in [{path}]" if path else "at the top"
        text = f"{_join(path, _shown(name, bare=True))} is no key of a cell file. "
        near = difflib.get_close_matches(name[:_SHOWN], names, 1)
        other = next((kind for kind, keys in table.variants.items() if name in [each.name for each in keys]), None)
        elsewhere = next((row for row, key in rows() if key.name == name), None)
        if near:
            text += f"Did you mean {near[0]}? "
        elif other is not None:
            text += f"It is one with kind = {json.dumps(other)} only. "
        elif elsewhere is not None:
            text += f"Did you mean {elsewhere}? "
        self.findings.append(f"{text}Allowed {place} are {', '.join(names)}. Correct it, or take it out")


def _text_is_legal(value: str, key: Key) -> bool:
    if key.choices:
        return value in key.choices
    if key.name == "host":
        try:
            ipaddress.IPv4Address(value)
        except ValueError:
            return False
        return True
    if key.name == "task":
        from dual_ur10.ids import ENV_IDS

        return value in ENV_IDS
    return re.fullmatch(key.pattern[0], value, re.ASCII) is not None


def _rules(values: Mapping[str, Any]) -> Iterator[str]:
    """What does not fit together."""
    emulated = values["kind"] == "emulated"
    for arm in ARMS:
        yield from _host_fits(values["kind"], f"{arm}.host", values[arm]["host"])
    if values["left"]["host"] == values["right"]["host"]:
        yield (
            f"right.host is {values['right']['host']}, as left.host is: each arm has a controller of its own. "
            "Write both addresses as the controllers show them"
        )
    yield from _bases(values)
    for arm in ARMS:
        yield from _servoj(arm, values[arm])
    if values["emulator"] is not None and not emulated:
        yield 'emulator is in the file of a real cell: it is allowed with kind = "emulated" only. Take the table out'
    tracker = values["tracker"]
    if tracker is not None and tracker["kind"] == "emulated" and (not emulated or values["emulator"] is None):
        yield (
            'tracker.kind is "emulated": only an emulated cell has such a camera, and the table [emulator] says where. '
            'Use "attached" or "given", or the file that `emulate --cell` writes'
        )
    yield from _obstacles(values)


def _host_fits(kind: str, path: str, host: str) -> Iterator[str]:
    address = ipaddress.IPv4Address(host)
    if kind == "emulated" and not address.is_loopback:
        yield (
            f'{path} is {host} with kind = "emulated": emulated controllers have loopback addresses, 127.0.0.0/8. '
            'If a robot is there, write kind = "real"'
        )
    elif kind == "real" and address.is_loopback:
        yield (
            f'{path} is {host} with kind = "real": no robot is at a loopback address. Write its own address, or '
            'kind = "emulated"'
        )
    elif kind == "real" and (address.is_unspecified or address.is_multicast or address.is_reserved):
        yield f"{path} is {host}: no single machine has this address. Write the one that the controller shows"


def mount_of(arm: int, values: Mapping[str, Any]) -> ArmMount:
    """Where an arm stands, by the checked values of its table.

    Args:
        arm: 0 or 1.
        values: As `read` returns them.

    Raises:
        SettingsError: The calibration is not that of a UR10, or the base is under the floor.
    """
    position = values["base_position_m"]
    if position is None:
        position = SceneSettings().mounts[arm].position_m
    dh = DHParameters(**{name: values["calibration"][name] for name in _CALIBRATION})
    return ArmMount(position, values["base_yaw_rad"], dh)


def _bases(values: Mapping[str, Any]) -> Iterator[str]:
    mounts = []
    for row, arm in enumerate(ARMS):
        try:
            mounts.append(mount_of(row, values[arm]))
        except SettingsError as error:
            key = "calibration" if "DH" in str(error) else "base_position_m"
            yield f"{arm}.{key}: {error}. Write the figures of this arm"
    if len(mounts) == 2:
        try:
            SceneSettings(left=mounts[0], right=mounts[1])
        except SettingsError as error:
            yield f"left.base_position_m and right.base_position_m: {error}. Write where the bases stand"


def _servoj(arm: str, values: Mapping[str, Any]) -> Iterator[str]:
    profile = ServojProfile(values["family"], **values["servoj"])
    if profile.damping < LEAST_DAMPING:
        least = (2 * LEAST_DAMPING / profile.lookahead_s) ** 2
        yield (
            f"{arm}.servoj.gain is {profile.gain:g} with lookahead_s = {profile.lookahead_s:g}: the arm would swing "
            f"(damping {profile.damping:.2f}, allowed is {LEAST_DAMPING} or more). Choose a gain of {math.ceil(least)} "
            "or more, or a longer lookahead"
        )


def _obstacles(values: Mapping[str, Any]) -> Iterator[str]:
    seen: dict[str, int] = {}
    for row, each in enumerate(values["obstacle"]):
        path = f"obstacle[{row}]"
        if each["name"] in seen:
            yield f"{path}.name is {each['name']!r}, as that of obstacle[{seen[each['name']]}]: choose another"
        seen.setdefault(each["name"], row)
        if each["kind"] != "plane":
            continue
        length = math.hypot(*each["normal"])
        if abs(length - 1) > _UNIT_TOLERANCE:
            yield f"{path}.normal has the length {length:.6g}: allowed is 1. Divide it by its length"
            continue
        for number, arm in enumerate(ARMS):
            base = values[arm]["base_position_m"] or SceneSettings().mounts[number].position_m
            ahead_m = _dot(each["normal"], [a - b for a, b in zip(base, each["point_m"], strict=True)])
            if ahead_m < -_BEHIND_M:
                yield (
                    f"{path}.normal points away from the {arm} base, which is {-ahead_m:.3g} m behind the plane: the "
                    "arms are in front of it. Turn the normal round, or move the point"
                )


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _shown(value: Any, bare: bool = False, depth: int = 0) -> str:
    """A value as a message may show it: short, and on one line."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 10**30:
        return "a very large number"  # Python refuses to write the largest
    if isinstance(value, Mapping):
        return "a table"
    if depth > _DEPTH:
        return "..."
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        inside = ", ".join(_shown(each, depth=depth + 1) for each in value[:8]) + ", ..." * (len(value) > 8)
        text = f"[{inside}]"
    elif isinstance(value, str):
        text = json.dumps(value[: 2 * _SHOWN])
        text = text[1:-1] if bare else text
    else:
        text = str(value)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
