"""Props as data: objects and fixtures of a scene, each an MJCF text with what other layers need to know of it."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from dual_ur10.errors import SettingsError, UnknownNameError
from ur_core.kinematics.ur10 import ARMS
from ur_core.mjcf.camera import Camera, cameras_of
from ur_core.types import Vector3

_SECTIONS: Final = ("compiler", "asset", "default", "worldbody", "contact", "equality")
_RESERVED: Final = (*ARMS, "cell", "floor", "table", "obstacle")
_MOST_CHARACTERS: Final = 1_000_000
_NAME: Final = re.compile(r"[A-Za-z]\w{0,39}")
_MOST_M: Final = 2.0  # of a capsule from the tool centre point
_JOINTS: Final = ("hinge", "slide")


def _finite(what: str, values: Sequence[float], count: int) -> tuple[float, ...]:
    try:
        numbers = tuple(float(each) for each in values)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise SettingsError(f"{what} is {values!r}: it must be {count} finite number{'s' if count > 1 else ''}")
    return numbers


@dataclass(frozen=True)
class HeldCapsule:
    """Capsule around a prop that an arm holds, in the frame of its tool centre point.

    Attributes:
        from_m, to_m: Ends of its axis.
        radius_m: Its radius.

    Raises:
        SettingsError: A value is not finite, an end is more than 2 m away, or the radius is not above 0.
    """

    from_m: Vector3
    to_m: Vector3
    radius_m: float

    def __post_init__(self) -> None:
        for name in ("from_m", "to_m"):
            value = _finite(f"{name} of a capsule", getattr(self, name), 3)
            if math.hypot(*value) > _MOST_M:
                raise SettingsError(f"{name} of a capsule is {value}: it must be within {_MOST_M:g} m of the tool")
            object.__setattr__(self, name, value)
        (radius_m,) = _finite("radius_m of a capsule", (self.radius_m,), 1)
        if not 0.0 < radius_m <= _MOST_M:
            raise SettingsError(f"radius_m of a capsule is {radius_m:g}: it must be above 0 and at most {_MOST_M:g} m")
        object.__setattr__(self, "radius_m", radius_m)


@dataclass(frozen=True, kw_only=True)
class Prop:
    """Object or fixture of a scene: free, fixed, placed, or articulated.

    Its MJCF has one body in `worldbody`. With a free joint it is an object that arms move. With `mocap="true"` an
    episode places it, and nothing moves it. Otherwise it stands where the MJCF has it. Hinges and slides below are
    joints of the prop. In the model of the cell all names get the prefix "<name>/".

    Attributes:
        name: Its key in `CellState.objects`, `Start.objects` and cell files: letters, digits and _.
        mjcf: MJCF text with the sections compiler, asset, default, worldbody, contact and equality; or an `MjSpec`, of
            which MuJoCo writes six digits; or a model of `dm_control.mjcf`, or an entity of `dm_control.composer`.
            Geoms of group 2 that collide with nothing are drawn only, and have no mass.
        held: What a gripper carries, for the distances of the safety gate: a capsule for the left and for the right
            arm, or None. Nothing reports to the gate whether a gripper holds something, so an empty gripper keeps
            these distances, too.
        tracked: True if something measures its pose on controllers; False if its pose there is that of the start. Left
            out: True for a free prop or one with joints.
        noise: Factor on the errors of the measured pose that `Randomization` states.
        mass: Factor on the variation of a free prop's mass that `Randomization` states.
        rigid: True if its contacts are as stiff as the physics step allows; False: as the MJCF has them.
        cameras: Cameras on the prop, or on one of its bodies, that move with it.

    Raises:
        SettingsError: The text is no such MJCF, or another value is not legal.
        UnknownNameError: The prop has no such body as a camera names.
    """

    name: str
    mjcf: str
    held: tuple[HeldCapsule | None, HeldCapsule | None] = (None, None)
    tracked: bool | None = None
    noise: float = 1.0
    mass: float = 1.0
    rigid: bool = True
    cameras: tuple[Camera, ...] = ()
    body: str = field(init=False, repr=False, compare=False)
    """Name of its body in the model of the cell."""
    free: bool = field(init=False, repr=False, compare=False)
    """True if it has a free joint."""
    placed: bool = field(init=False, repr=False, compare=False)
    """True if it is a mocap body."""
    located: bool = field(init=False, repr=False, compare=False)
    """True if its MJCF states the position of its body."""
    joints: tuple[str, ...] = field(init=False, repr=False, compare=False)
    """Names of its hinges and slides, in the order of the model, without the prefix."""

    def __post_init__(self) -> None:
        name = self.name
        if not isinstance(name, str) or _NAME.fullmatch(name) is None or name in _RESERVED:
            raise SettingsError(
                f"the name of a prop is {name!r}: use letters, digits and _, a letter first, and none of "
                f"{', '.join(_RESERVED)}"
            )
        text: Any = self.mjcf if isinstance(self.mjcf, str) else _text_of(self.mjcf, name)
        root = _parsed(text, name)
        (top,) = _bodies(root, name)
        _settle_joints(top, name)
        if any(True for _ in top.iter("camera")):
            raise SettingsError(
                f"the prop {name!r} has a <camera> in its MJCF: leave it out, and give the prop a Camera, "
                "Prop(cameras=...), or the task's scene one, Equipment(cameras=...)"
            )
        top.set("name", top.get("name", "body"))
        object.__setattr__(self, "cameras", cameras_of(self.cameras, f"the prop {name!r}"))
        named = [str(top.get("name")), *(each.get("name", "") for each in top.iter("body") if each is not top)]
        for camera in self.cameras:
            if camera.body and camera.body not in named:
                known = [each for each in named if each]
                raise UnknownNameError(f"body of the camera {camera.name!r} of the prop {name!r}", camera.body, known)
        free = [each for each in top if _is_free(each)]
        joints = [each for each in top.iter("joint") if each.get("type", "hinge") != "free"]
        unnamed = [each for each in joints if not each.get("name")]
        if unnamed:
            raise SettingsError(f"the prop {name!r} has a joint without a name: `CellState.joints` is by name")
        placed = top.get("mocap") == "true"
        values = {
            "mjcf": ET.tostring(root, encoding="unicode"),
            "body": f"{name}/{top.get('name')}",
            "free": bool(free),
            "placed": placed,
            "located": "pos" in top.attrib,
            "joints": tuple(str(each.get("name")) for each in joints),
            "tracked": bool(free or joints) if self.tracked is None else bool(self.tracked),
        }
        for key, value in values.items():
            object.__setattr__(self, key, value)
        for key in ("noise", "mass"):
            (value,) = _finite(f"{key} of the prop {name!r}", (getattr(self, key),), 1)
            if not 0.0 <= value <= 100.0:
                raise SettingsError(f"{key} of the prop {name!r} is {value:g}: it must be 0 to 100")
            object.__setattr__(self, key, value)
        if len(self.held) != 2 or not all(each is None or isinstance(each, HeldCapsule) for each in self.held):
            raise SettingsError(f"held of the prop {name!r} is {self.held!r}: it must be two, each HeldCapsule or None")
        object.__setattr__(self, "held", tuple(self.held))

    def body_named(self, name: str) -> str:
        """Return the name of one of its bodies in the model of the cell; "": that of the prop itself."""
        return f"{self.name}/{name}" if name else self.body

    @property
    def posed(self) -> bool:
        """True if its pose differs from episode to episode, or moves."""
        return self.free or self.placed

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of all its joints in the model of the cell, in the order of `qpos`."""
        return (*((f"{self.name}/free",) if self.free else ()), *(f"{self.name}/{each}" for each in self.joints))

    def add_to(self, spec: Any, timestep_s: float, *, visuals: bool = True) -> None:
        """Attach the prop to the spec of a cell.

        Args:
            spec: `MjSpec` of the cell.
            timestep_s: Physics step.
            visuals: Include what is drawn only.

        Raises:
            SettingsError: MuJoCo refuses the MJCF.
        """
        import mujoco

        from dual_ur10.assets.gripper import RIGID, stiff

        try:
            own = mujoco.MjSpec.from_string(self.mjcf)
        except ValueError as error:
            raise SettingsError(f"the MJCF of the prop {self.name!r} is refused: {_reason(error)}") from error
        for geom in list(own.geoms):
            collides = geom.contype or geom.conaffinity
            if not collides and geom.group == 2:
                geom.mass = 0.0
                if not visuals:
                    own.delete(geom)
            elif collides and self.rigid:
                geom.solref, geom.solimp = stiff(timestep_s), RIGID
        if not visuals:
            for each in (*own.geoms, *own.sites):
                each.material = ""
            for each in (*own.materials, *own.textures):
                own.delete(each)
        spec.attach(own, prefix=f"{self.name}/", frame=spec.worldbody.add_frame())

    def check(self) -> None:
        """Compile the prop alone, so that an error in its MJCF is named.

        Raises:
            SettingsError: MuJoCo refuses it: a mesh is missing, a moving body has no mass, names are equal, ...
        """
        import mujoco

        for visuals in (True, False):
            spec = mujoco.MjSpec()
            self.add_to(spec, 0.002, visuals=visuals)
            try:
                spec.compile()
            except ValueError as error:
                raise SettingsError(f"the prop {self.name!r} cannot be compiled: {_reason(error)}") from error


def check_props(props: Sequence[Prop]) -> tuple[Prop, ...]:
    """Check the props of a scene together.

    Raises:
        SettingsError: They are no props, or two have the same name or joint.
    """
    if isinstance(props, str | Prop) or not all(isinstance(each, Prop) for each in props):
        raise SettingsError(f"props is {props!r:.80}: it must be a tuple of Prop")
    for what, names in (
        ("name", [each.name for each in props]),
        ("joint", [joint for each in props for joint in each.joints]),
    ):
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise SettingsError(f"two props have the {what} {twice[0]!r}: give each its own")
    return tuple(props)


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()).removeprefix("Error: ")


def _text_of(spec: Any, name: str) -> str:
    from dual_ur10.assets.dm_mjcf import is_dm_mjcf, text_of

    if is_dm_mjcf(spec):
        return text_of(spec, name)
    try:
        spec.compile()
        text = spec.to_xml()
    except (AttributeError, ValueError) as error:
        raise SettingsError(
            f"mjcf of the prop {name!r} is {type(spec).__name__}: it must be MJCF text or a MjSpec that compiles "
            f"({_reason(error)}), or a model or entity of dm_control"
        ) from error
    return str(text)


def _parsed(text: str, name: str) -> ET.Element:
    if len(text) > _MOST_CHARACTERS:
        raise SettingsError(f"the MJCF of the prop {name!r} has {len(text)} characters: at most {_MOST_CHARACTERS}")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise SettingsError(f"the MJCF of the prop {name!r} is no XML: {error}") from error
    for default in root.iter("default"):
        if any(joint.get("type") for joint in default.findall("joint")):
            raise SettingsError(f"the prop {name!r} has the type of joints in a default: state it in each joint")
    found = [each.tag for each in root]
    strange = [each for each in found if each not in _SECTIONS]
    if root.tag != "mujoco" or strange:
        what = f"<{strange[0]}>" if strange else f"<{root.tag}> at its root"
        raise SettingsError(
            f"the MJCF of the prop {name!r} has {what}: it must be <mujoco> with {', '.join(_SECTIONS)} only"
        )
    return root


def _bodies(root: ET.Element, name: str) -> list[ET.Element]:
    bodies = [each for world in root.findall("worldbody") for each in world]
    if len(bodies) != 1 or bodies[0].tag != "body":
        raise SettingsError(
            f"the MJCF of the prop {name!r} has {', '.join(f'<{each.tag}>' for each in bodies) or 'nothing'} in its "
            "worldbody: it must be one <body>; further objects are props of their own"
        )
    return bodies


def _is_free(element: ET.Element) -> bool:
    return element.tag == "freejoint" or (element.tag == "joint" and element.get("type") == "free")


def _settle_joints(top: ET.Element, name: str) -> None:
    """Check the joints of a prop, and name its free joint.

    Raises:
        SettingsError: There are several free joints, one that is not of the top body, or a ball joint.
    """
    free = [each for each in top.iter() if _is_free(each)]
    if len(free) > 1 or any(each not in list(top) for each in free):
        raise SettingsError(
            f"the prop {name!r} has {len(free)} free joints, or one below its body: at most one, of the body itself, "
            "is allowed. Another free object is another prop"
        )
    if free and top.get("mocap") == "true":
        raise SettingsError(f"the prop {name!r} has a free joint and mocap: leave one out")
    for each in free:
        each.set("name", "free")
    kinds = {each.get("type", "hinge") for each in top.iter("joint") if not _is_free(each)}
    if kinds - set(_JOINTS):
        raise SettingsError(
            f"the prop {name!r} has a joint of the type {min(kinds - set(_JOINTS))}: use hinge or slide"
        )
