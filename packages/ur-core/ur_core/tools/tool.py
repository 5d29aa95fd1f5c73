"""Tools: all that the package knows of a gripper, as data.

A tool is a parallel-jaw gripper. Its frame is the flange's: z is the approach, the fingers open along y, the pads'
width lies along x. Simulation, safety gate, adapter, tasks, scripted policies and drivers take their numbers from the
tools of the cell, one for each arm.
"""

from __future__ import annotations

import importlib.metadata
import math
import re
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np

from ur_core.errors import SettingsError, UnknownNameError
from ur_core.mjcf.camera import Camera, cameras_of
from ur_core.objects import load_object
from ur_core.types import Array, Vector3

GROUP: Final = "dual_ur10.tools"
"""Entry-point group of installed packages: name of a tool, and where its `Tool` is."""

WRIST: Final = "wrist"
"""Name of the camera that every tool has."""

_OWN: Final = {
    "robotiq_2f85": "ur_core.tools.robotiq_2f85:ROBOTIQ_2F85",
    "generic_140": "ur_core.tools.generic_140:GENERIC_140",
}
_LEAST_M, _LARGEST_M = 1e-5, 1.0
_SIZES: Final = {"speed_m_s": 2, "force_n": 2, "palm_size_m": 2, "pad_m": 3}
_DRIVERS: Final = "[a-z_]{1,40}|[A-Za-z_][A-Za-z0-9_.]{0,150}:[A-Za-z_][A-Za-z0-9_]{0,40}"


@dataclass(frozen=True, kw_only=True)
class Tool:
    """One gripper. All fields are plain values, so that a record can hold them.

    The safety gate measures a capsule around the palm, along y, and a box around all positions of the fingers: from
    `palm_m` to the fingertips, as wide as fully open fingers. All that may touch must lie in them.

    Attributes:
        name: Name in cell files, records and messages.
        title: Name for people.
        drivers: Kinds of gripper in a cell file that can drive it, and drivers of one's own, "module:Class". Emulated
            cells have the first.
        tcp_m: Flange to tool centre point, the middle of the pads, along z.
        stroke_m: Largest distance of the pads; 0 is closed.
        speed_m_s: (2,) least and largest speed of the opening.
        force_n: (2,) least and largest grip force.
        mass_kg: With fingers and coupling.
        com_m: Flange to the centre of mass of all but the fingers, along z.
        palm_m: Flange to where the fingers begin, along z.
        palm_size_m: (2,) sides of the palm along x and y, for its inertia.
        palm_radius_m, palm_half_m, palm_z_m: Capsule around the palm: radius, half its length along y, and height.
        finger_mass_kg: Mass of one finger.
        finger_width_m, finger_thick_m: Finger along x; pad and what carries it along y.
        pad_m: (3,) one pad: width along x, thickness along y, length along z.
        servo_kp, servo_kv: Stiffness and damping of the servo of the opening in simulation.
        armature_kg: Reflected inertia of the drive at each finger.
        mjcf: MJCF of the moving gripper, for simulation, see `dual_ur10.assets.gripper.attach_own`; "": composed of
            these figures.
        visuals: "module:function" that draws it, see `dual_ur10.assets.visuals.draw_gripper`; "": drawn from these
            figures.
        cameras: Cameras on it. One is named "wrist": where it is left out, it looks from the palm at the fingertips.

    Raises:
        SettingsError: A value is not legal.
    """

    name: str
    title: str
    drivers: tuple[str, ...]
    tcp_m: float
    stroke_m: float
    speed_m_s: tuple[float, float]
    force_n: tuple[float, float]
    mass_kg: float
    com_m: float
    palm_m: float
    palm_size_m: tuple[float, float]
    palm_radius_m: float
    palm_half_m: float
    palm_z_m: float
    finger_mass_kg: float
    finger_width_m: float
    finger_thick_m: float
    pad_m: Vector3
    servo_kp: float
    servo_kv: float
    armature_kg: float
    mjcf: str = ""
    visuals: str = ""
    cameras: tuple[Camera, ...] = ()

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and re.fullmatch(r"[A-Za-z0-9_-]{1,64}", self.name)):
            raise SettingsError(f"a tool is named {self.name!r}: allowed are up to 64 letters, digits, _ and -")
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, list):
                value = tuple(value)
                object.__setattr__(self, each.name, value)
            if each.name == "drivers":
                self._check_drivers(value)
            elif each.name == "cameras":
                object.__setattr__(self, "cameras", cameras_of(value, f"the tool {self.name!r}"))
            elif each.type == "str":
                if not isinstance(value, str):
                    raise SettingsError(f"{each.name} of the tool {self.name!r} is {value!r:.80}: it must be text")
            elif each.name in _SIZES and not (isinstance(value, tuple) and len(value) == _SIZES[each.name]):
                raise SettingsError(
                    f"{each.name} of the tool {self.name!r} is {value!r:.80}: it must be {_SIZES[each.name]} numbers"
                )
            else:
                numbers: tuple[object, ...] = value if isinstance(value, tuple) and each.name in _SIZES else (value,)
                for number in numbers:
                    self._check(each.name, number)
        for name in ("speed_m_s", "force_n"):
            least, most = getattr(self, name)
            if least > most:
                raise SettingsError(f"{name} of the tool {self.name!r} is {least:g} to {most:g}: write the least first")
        if not self.palm_m < self.tcp_m < self.fingertip_m:
            raise SettingsError(
                f"tcp_m of the tool {self.name!r} is {self.tcp_m:g}: it must be beyond palm_m, {self.palm_m:g} m"
            )
        if self.mass_kg <= 2 * self.finger_mass_kg:
            raise SettingsError(
                f"mass_kg of the tool {self.name!r} is {self.mass_kg:g}: it must be more than that of both fingers, "
                f"{2 * self.finger_mass_kg:g} kg"
            )
        if self.pad_m[1] >= self.finger_thick_m:
            raise SettingsError(
                f"pads of the tool {self.name!r} are {self.pad_m[1]:g} m thick: finger_thick_m, which counts the pad, "
                f"is {self.finger_thick_m:g}, and must be more"
            )

    @classmethod
    def received(cls, **values: Any) -> Tool:
        """Return the tool of fields that a record holds, drawn as the registered one of its name, or from its figures.

        No function is called that the record names.

        Raises:
            SettingsError: A value is not legal.
        """
        tool = cls(**{**values, "visuals": ""})
        try:
            return replace(tool, visuals=tool_named(tool.name).visuals)
        except (SettingsError, UnknownNameError):
            return tool

    def _check_drivers(self, drivers: Any) -> None:
        known = isinstance(drivers, tuple) and len(drivers) > 0
        if not (known and all(isinstance(each, str) and re.fullmatch(_DRIVERS, each) for each in drivers)):
            raise SettingsError(
                f"drivers of the tool {self.name!r} is {drivers!r:.80}: it must be a tuple of at least one kind, such "
                'as "robotiq", or driver of your own, "module:Class"'
            )

    def _check(self, name: str, number: object) -> None:
        if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number) or number <= 0:
            raise SettingsError(f"{name} of the tool {self.name!r} is {number!r}: it must be above 0 and finite")
        if name.endswith("_m") and not _LEAST_M <= number <= _LARGEST_M:
            raise SettingsError(
                f"{name} of the tool {self.name!r} is {number:g} m: allowed are {_LEAST_M:g} to {_LARGEST_M:g} m"
            )

    @property
    def views(self) -> tuple[Camera, ...]:
        """Its cameras, with that of the wrist."""
        if any(each.name == WRIST for each in self.cameras):
            return self.cameras
        # Upwards in the image is away from the base where the arm is at home.
        position = (-self.palm_radius_m, 0.0, self.palm_m)
        return (Camera(WRIST, position, (0.0, 0.0, self.fingertip_m), 72.0, up=(-1.0, 0.0, 0.0)), *self.cameras)

    @property
    def fingertip_m(self) -> float:
        """Flange to fingertips, along z."""
        return self.tcp_m + self.pad_m[2] / 2


def strokes_m(tools: tuple[Tool, Tool]) -> tuple[float, float]:
    """Return the largest width of each gripper."""
    return tools[0].stroke_m, tools[1].stroke_m


def levers_m(tools: tuple[Tool, Tool]) -> Array:
    """Return the tool centre points in the flange frames, (2, 3)."""
    return np.array([[0.0, 0.0, tool.tcp_m] for tool in tools])


def tool_names() -> list[str]:
    """Return the names of the tools of this package and of installed ones."""
    return [*_OWN, *sorted({each.name for each in importlib.metadata.entry_points(group=GROUP)} - {*_OWN})]


def tool_named(name: str) -> Tool:
    """Return the tool of a name: one of this package, or one that an installed package names in `GROUP`.

    Args:
        name: Its name, or "module:NAME" of any `Tool`.

    Raises:
        UnknownNameError: There is none.
        SettingsError: Its package cannot be imported, or has no `Tool` of this name there.
    """
    path = _OWN.get(name, name)
    if ":" in path:
        tool = load_object(path, "the tool", registered=name in _OWN)
        if not isinstance(tool, Tool):
            raise SettingsError(f"{path} is {tool!r:.80}: expected is a Tool")
        return tool
    installed = {each.name: each for each in importlib.metadata.entry_points(group=GROUP)}
    if name not in installed:
        raise UnknownNameError("tool", str(name), tool_names(), "module:NAME of a Tool")
    entry = installed[name]
    try:
        found = entry.load()
    except (Exception, SystemExit) as error:  # of any kind: it is another package's
        raise SettingsError(f"the tool {name!r} cannot be loaded from {entry.value}: {error!r}") from error
    if not isinstance(found, Tool) or found.name != name:
        raise SettingsError(f"{entry.value} is {found!r:.80}: expected is a Tool with the name {name!r}")
    return found


def tools_of(values: object) -> tuple[Tool, Tool]:
    """Return the tools of the left and the right arm, given as `Tool` or by name.

    Raises:
        UnknownNameError: There is no tool of a name.
        SettingsError: They are not two tools.
    """
    if not isinstance(values, tuple | list) or len(values) != 2:
        raise SettingsError(f"tools is {values!r:.80}: it must be the tools of the left and the right arm")
    for each in values:
        if not isinstance(each, Tool | str):
            raise SettingsError(f"{each!r:.80} among the tools must be a Tool or the name of one")
    left, right = (tool_named(each) if isinstance(each, str) else each for each in values)
    return left, right
