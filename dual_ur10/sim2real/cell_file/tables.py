"""Tables of a cell file as pydantic models: every key once, with its type, bounds, default and description.

All else follows from these models: validation, the JSON schema, the template that `cell new` writes and the reference
page. A key's unit is part of its name. Keys are written in the order in which they stand here, so that equal files have
equal texts and hashes.

Tables made by hand raise `pydantic.ValidationError`; reading and changing a cell file raises `CellFileError`.
"""

from __future__ import annotations

import ipaddress
import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Final, Literal, Self, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from dual_ur10.assets import obstacles
from dual_ur10.ids import ENV_IDS, is_registered
from ur_core.kinematics import ur10
from ur_core.kinematics.frames import MAX_MOUNT_M, MAX_TILT_RAD, ArmMount
from ur_core.kinematics.robots import MODEL_OF_FAMILY, MOST_PAYLOAD_KG, ROBOTS
from ur_core.kinematics.ur10 import NOMINAL_DH, DHParameters, Family, nominal_dh
from ur_core.mjcf import gains
from ur_core.mjcf.camera import Camera
from ur_core.servoj import GAIN_RANGE, LOOKAHEAD_RANGE_S, MEASURED_LOOKAHEAD_S, ServojProfile
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85

Kind = Literal["real", "emulated"]

ZERO: Final = (0.0, 0.0, 0.0)
LEVEL: Final = (0.0, 0.0)
MAX_OBSTACLES: Final = 64
MAX_LATENCY_S: Final = 0.3
ROBOTIQ_PORT: Final = 63352
"""TCP port of Robotiq's URCap."""

_TURN: Final = 2 * math.pi
_ROOM_M: Final = obstacles.ROOM_M
_LIMIT: Final = "the hard limit"

T = TypeVar("T")
Vector = tuple[T, T, T]
Pair = tuple[T, T]
Joints = tuple[T, T, T, T, T, T]

Angle = Annotated[float, Field(ge=-_TURN, le=_TURN)]
Tilt = Annotated[float, Field(ge=-MAX_TILT_RAD, le=MAX_TILT_RAD)]
Offset = Annotated[float, Field(ge=-1, le=1)]
"""Coordinate in a flange frame, m."""
Place = Annotated[float, Field(ge=-MAX_MOUNT_M, le=MAX_MOUNT_M)]
"""Coordinate in the cell frame within reach of the arms, m."""
Coordinate = Annotated[float, Field(ge=-_ROOM_M, le=_ROOM_M)]
"""Coordinate in the cell frame, m."""
Checksum = Annotated[int, Field(ge=0, le=2**32 - 1)]


def key(
    description: str,
    default: Any = ...,
    *,
    low: float | None = None,
    high: float | None = None,
    example: Any = None,
    if_real: bool = False,
    note: str = "",
) -> Any:
    """Return the description of a key as pydantic's field.

    Args:
        description: What the key holds, for the template and the reference page.
        default: Value where the file leaves the key out; `...`: the key is required; None: there is no value.
        low: Smallest legal number.
        high: Largest legal number.
        example: A legal value for messages; None: the default is one.
        if_real: Whether the file of a real cell has to name it.
        note: Remark on the range.
    """
    extra = {"if_real": if_real or None, "note": note or None}
    given: dict[str, Any] = {
        "ge": low,
        "le": high,
        "examples": None if example is None else [example],
        "json_schema_extra": {name: value for name, value in extra.items() if value} or None,
    }
    # An explicit None would override what the type of the field brings.
    return Field(default, description=description, **{name: each for name, each in given.items() if each is not None})


def _checked_address(text: str) -> str:
    ipaddress.IPv4Address(text)  # raises a ValueError
    return text


def _checked_id(text: str) -> str:
    # A file of a task that others bring stays readable where that task is not installed: its latch must be cleared.
    others = re.fullmatch(r"\w{1,60}/\w{1,60}-v\d{1,6}", text) is not None and not text.startswith("DualUR10/")
    if not others and not is_registered(text):
        raise ValueError(text)
    return text


def _checked_model(text: str) -> str:
    if text not in ROBOTS:
        raise ValueError(text)
    return text


def _no_constant(name: str) -> None:
    raise ValueError(name)  # NaN and Infinity are not JSON


def read_keywords(text: str) -> dict[str, Any]:
    """Return the keywords of a task that a text has, a JSON object; lists become tuples.

    Raises:
        ValueError: It is another text.
    """
    try:
        found = _tuples(json.loads(text, parse_constant=_no_constant))
    except RecursionError as error:
        raise ValueError(text) from error
    if not isinstance(found, dict):
        raise ValueError(text)
    return found


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _tuples(each) for name, each in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _checked_keywords(text: str) -> str:
    read_keywords(text)
    return text


def _text(allowed: str, **constraints: Any) -> Any:
    return Field(json_schema_extra={"allowed": allowed}, **constraints)


Name = Annotated[str, _text("up to 64 letters, digits, _ and -, in quotes", pattern=f"^{obstacles.NAME}$")]
Serial = Annotated[str, _text("up to 32 letters, digits and hyphens, in quotes", pattern="^[A-Za-z0-9-]{1,32}$")]
Address = Annotated[str, AfterValidator(_checked_address), _text("an IPv4 address; names are not looked up")]
_MEMBER: Final = "[A-Za-z_][A-Za-z0-9_.]{0,150}:[A-Za-z_][A-Za-z0-9_]{0,40}"
ToolName = Annotated[
    str,
    _text(
        "the name of a tool, or module:NAME, in quotes",
        pattern=f"^([A-Za-z0-9_-]{{1,64}}|{_MEMBER})$",
    ),
]
Day = Annotated[str, _text("a day such as 2026-01-31, in quotes", pattern=r"^\d{4}-\d{2}-\d{2}$")]
FileName = Annotated[str, _text("a file name of up to 200 characters, in quotes", pattern=r"^[^\x00-\x1f\x7f]{1,200}$")]
Model = Annotated[str, AfterValidator(_checked_model), _text("one of " + ", ".join(f'"{each}"' for each in ROBOTS))]
Task = Annotated[str, AfterValidator(_checked_id), _text("the id of an environment")]
Keywords = Annotated[str, AfterValidator(_checked_keywords), _text("a JSON object, in quotes", max_length=4000)]
ClassName = Annotated[str, _text("module:Class, in quotes", pattern=f"^{_MEMBER}$")]
_OPTION: Final = "[a-z_]{1,30}=[!-~]{0,99}"
Options = Annotated[
    str, _text("NAME=VALUE, separated by spaces, in quotes", pattern=f"^(|{_OPTION}( {_OPTION}){{0,9}})$")
]


def keywords_of(options: str) -> dict[str, Any]:
    """Return options of a class of one's own as keywords: numbers and truth values as such, all others as text."""
    found: dict[str, Any] = {}
    for each in options.split():
        name, _, text = each.partition("=")
        try:
            found[name] = json.loads(text)
        except ValueError:
            found[name] = text
    return found


class Table(BaseModel):
    """A table of a cell file: frozen, strict about types, without unknown keys."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)

    def replace(self, **changes: Any) -> Self:
        """Return this table with some keys changed; they are checked when the table becomes part of a cell file."""
        return self.model_copy(update=changes)

    def mapping(self) -> dict[str, Any]:
        """Return the table with all defaults, without keys that have no value and without empty tables."""
        return _without_nothing(self.model_dump(warnings=False))


def _without_nothing(values: Mapping[str, Any]) -> dict[str, Any]:
    kept = {}
    for name, value in values.items():
        inner = _without_nothing(value) if isinstance(value, Mapping) else value
        if isinstance(value, tuple):
            inner = tuple(_without_nothing(each) if isinstance(each, Mapping) else each for each in value)
        if inner is not None and inner not in ({}, ()):
            kept[name] = inner
    return kept


_TOOL: Final = (
    "tool at the flange: robotiq_2f85, generic_140, one that an installed package names, or module:NAME of your own"
)


_OPTIONS: Final = "further arguments of the class"


class NoGripper(Table):
    """Flange without a gripper."""

    kind: Literal["none"] = "none"


class RobotiqSocket(Table):
    """Robotiq gripper behind the text protocol of its URCap, on the arm's controller."""

    kind: Literal["robotiq"] = "robotiq"
    port: int = key("TCP port of Robotiq's URCap", ROBOTIQ_PORT, low=1, high=65535)
    tool: ToolName = key(_TOOL, ROBOTIQ_2F85.name)


class DigitalGripper(Table):
    """Gripper that a digital output opens and closes."""

    kind: Literal["digital_output"] = "digital_output"
    output: int = key(
        "digital output that drives the gripper",
        low=0,
        high=17,
        note="0 to 7 standard, 8 to 15 configurable, 16 and 17 at the tool",
        example=0,
    )
    open_level: bool = key("level of the output that opens the gripper", False)
    tool: ToolName = key(_TOOL, ROBOTIQ_2F85.name)


class OwnGripper(Table):
    """Gripper with a driver of your own: a subclass of `GripperLink`, made with a `GripperRequest` and the options."""

    kind: Literal["own"] = "own"
    driver: ClassName = key("class of the driver", example="my_lab.gripper:SlimLink")
    tool: ToolName = key(_TOOL, example="my_lab.gripper:SLIM")
    options: Options = key(_OPTIONS, "")


def _with_kind(value: Any) -> Any:
    return {"kind": "none", **value} if isinstance(value, Mapping) else value


Gripper = Annotated[
    Annotated[NoGripper | RobotiqSocket | DigitalGripper | OwnGripper, Field(discriminator="kind")],
    BeforeValidator(_with_kind),
]


class Servoj(Table):
    """Arguments of servoj."""

    lookahead_s: float = key(
        "lookahead time", ServojProfile.lookahead_s, low=LOOKAHEAD_RANGE_S[0], high=LOOKAHEAD_RANGE_S[1]
    )
    gain: float = key("gain, in 1/s²", ServojProfile.gain, low=GAIN_RANGE[0], high=GAIN_RANGE[1])


class Measured(Table):
    """Results of `fit` on a recorded run of this arm; a missing key was not measured."""

    lookahead_s: float | None = key(
        "lookahead with which the law of servoj moves as the arm does",
        None,
        low=MEASURED_LOOKAHEAD_S[0],
        high=MEASURED_LOOKAHEAD_S[1],
        example=0.03,
    )
    latency_s: float | None = key(
        "time from sending a target until it acts", None, low=0, high=MAX_LATENCY_S, example=0.004
    )


class ArmLimits(Table):
    """Limits on the targets of this arm; where a key is missing, the hard limit holds."""

    speed_rad_s: float | None = key(
        "joint speed",
        None,
        low=0.01,
        high=max(float(model.hard_speed_rad_s.min()) for model in ROBOTS.values()),
        note=f"{_LIMIT} of the model's slowest joint, {ur10.HARD_SPEED_RAD_S.min():g} of a UR10; those of the joints "
        "hold if the key is missing",
        example=0.5,
    )
    acceleration_rad_s2: float | None = key(
        "joint acceleration", None, low=0.1, high=ur10.HARD_ACCELERATION_RAD_S2, note=_LIMIT, example=4.0
    )
    jerk_rad_s3: float | None = key("joint jerk", None, low=1.0, high=ur10.HARD_JERK_RAD_S3, note=_LIMIT, example=200.0)
    tcp_speed_m_s: float | None = key(
        "speed of flange, elbow and tool centre point",
        None,
        low=0.01,
        high=ur10.HARD_TCP_SPEED_M_S,
        note=_LIMIT,
        example=0.25,
    )


class Calibration(Table):
    """Kinematics as the controller's calibration reports them; those of the nominal model where a key is missing."""

    a_m: Joints[Annotated[float, Field(ge=-2, le=2)]] | None = key("DH link lengths", None, example=NOMINAL_DH.a_m)
    # Offsets of parallel joints shift freely against each other.
    d_m: Joints[Annotated[float, Field(ge=-1000, le=1000)]] | None = key(
        "DH link offsets", None, example=NOMINAL_DH.d_m
    )
    alpha_rad: Joints[Angle] | None = key("DH link twists", None, example=NOMINAL_DH.alpha_rad)
    theta_rad: Joints[Angle] | None = key("DH joint offsets", None, example=NOMINAL_DH.theta_rad)
    checksum: Joints[Checksum] | None = key(
        "the controller's checksum of each joint; another calibration is refused", None, example=(0,) * 6
    )


class ArmEntry(Table):
    """One arm and its controller."""

    host: Address = key("address of the controller", example="192.168.1.10")
    family: Family = key("controller family", "cb3", if_real=True)
    model: Model | None = key(
        "model of the robot, as its controller reports it; a missing one is a UR10, or a UR10e of the e-Series",
        None,
        example="ur10",
    )
    base_position_m: Vector[Place] | None = key(
        "position of the base in the cell frame", None, if_real=True, example=(-0.75, 0.6, 0.0)
    )
    base_yaw_rad: Angle = key("rotation of the base about the vertical; 0 faces +x", 0.0, if_real=True)
    base_tilt_rad: Pair[Tilt] | None = key(
        "tilt of the base after that: x and y of a rotation vector in the cell frame; a missing one is 0",
        None,
        note="set the same mounting on the pendant",
        example=(0.004, 0.0),
    )
    base_uncertainty_m: float = key("uncertainty of that position", 0.0, low=0, high=0.1)
    base_uncertainty_rad: float = key("uncertainty of that rotation, about any axis", 0.0, low=0, high=0.2)
    tcp_position_m: Vector[Offset] | None = key(
        "tool centre point in the flange frame, as set on the controller", None, if_real=True, example=ZERO
    )
    tcp_rotation_rad: Vector[Angle] | None = key(
        "orientation of the tool centre point, a rotation vector", None, if_real=True, example=ZERO
    )
    payload_kg: float | None = key(
        "payload, as set on the controller", None, low=0, high=MOST_PAYLOAD_KG, if_real=True, example=0.0
    )
    payload_cog_m: Vector[Offset] | None = key(
        "the payload's centre of gravity in the flange frame", None, if_real=True, example=ZERO
    )
    serial_number: Serial | None = key(
        "serial number of the robot; another robot is refused", None, example="2010300001"
    )
    safety_checksum: Checksum | None = key(
        "checksum of the safety settings; other settings are refused",
        None,
        note="the number that `doctor` shows, not what the pendant shows",
        example=0x57F4285B,
    )
    gripper: Gripper = Field(NoGripper(), description="how the gripper is driven")
    servoj: Servoj = Servoj()
    measured: Measured = Measured()
    limits: ArmLimits = ArmLimits()
    calibration: Calibration = Calibration()

    @property
    def profile(self) -> ServojProfile:
        """Controller family and servoj settings."""
        return ServojProfile(self.family, self.servoj.lookahead_s, self.servoj.gain)

    @property
    def robot(self) -> str:
        """Name of the arm's model."""
        return self.model or MODEL_OF_FAMILY[self.family]

    @property
    def mount(self) -> ArmMount:
        """Pose, model and kinematics of the arm.

        Raises:
            SettingsError: The calibration is not that of this model, or the base is under the floor.
        """
        dh = self.kinematics_of(self.calibration)
        return ArmMount(self.base_position_m or ZERO, self.base_yaw_rad, dh, self.robot, self.base_tilt_rad or LEVEL)

    def kinematics_of(self, calibration: Calibration) -> DHParameters:
        """Return the kinematics of this arm with a calibration.

        Raises:
            SettingsError: The calibration is not that of this model.
        """
        rows = calibration.model_dump(exclude={"checksum"}, exclude_none=True)
        return replace(nominal_dh(self.robot), **rows)

    @property
    def tcp(self) -> tuple[float, ...] | None:
        """(6,) tool centre point as UR's controllers have it: x, y, z in m, rotation vector in rad; None: unknown."""
        if self.tcp_position_m is None and self.tcp_rotation_rad is None:
            return None
        return (*(self.tcp_position_m or ZERO), *(self.tcp_rotation_rad or ZERO))


class BaseToBase(Table):
    """Pose of the right base in the left one's `base_link`, as `cell calibrate` found it."""

    position_m: Vector[Annotated[float, Field(ge=-2 * MAX_MOUNT_M, le=2 * MAX_MOUNT_M)]] = key(
        "position of the right base in the left one's frame", example=(0.0, -1.2, 0.0)
    )
    yaw_rad: Angle = key("rotation of the right base about the vertical, relative to the left one", example=0.0)
    tilt_rad: Pair[Tilt] | None = key("tilt of the right base after that, likewise", None, example=(0.004, 0.0))
    uncertainty_m: float = key("uncertainty of that position", low=0, high=0.1, example=0.0002)
    uncertainty_rad: float = key("uncertainty of that rotation, about any axis", low=0, high=0.2, example=0.0003)
    date: Day = key("day of the calibration", example="2026-01-31")
    data: FileName = key("its data file", example="touches.json")


class GainsEntry(Table):
    """Gains of the joint servos where these arms are emulated or simulated, as of a UR10; a task's own if missing."""

    kp_nm_rad: Joints[Annotated[float, Field(ge=gains.LEAST_GAIN, le=gains.MOST_KP_NM_RAD)]] = key(
        "stiffness of each joint, N·m/rad", example=gains.STIFF.kp_nm_rad
    )
    kv_nms_rad: Joints[Annotated[float, Field(ge=gains.LEAST_GAIN, le=gains.MOST_KV_NMS_RAD)]] = key(
        "damping of each joint, N·m·s/rad", example=gains.STIFF.kv_nms_rad
    )


class EmulatorEntry(Table):
    """The process that emulates the cell; it writes this table."""

    port: int = key("port of its fault injection, at the left host", low=1, high=65535, example=40000)
    task: Task | None = key("environment whose scene it simulates", None, example=ENV_IDS[0])
    settings: Keywords | None = key("keywords of its task, of `emulate --set`", None, example='{"duration_s": 20.0}')
    pid: int | None = key("its process id", None, low=1, high=2**31 - 1, example=1234)


class _TrackerEntry(Table):
    prop: Name = key("name of the object in the task", example="block")


class AttachedTrackerEntry(_TrackerEntry):
    """Object held by an arm."""

    kind: Literal["attached"] = "attached"
    arm: Literal["left", "right"] = key("arm whose gripper holds the object", "left")
    position_m: Vector[Offset] = key("position of the object in the frame of that flange", ZERO)
    rotation_rad: Vector[Angle] = key("orientation of the object there, a rotation vector", ZERO)


class GivenTrackerEntry(_TrackerEntry):
    """Object at a fixed pose in the cell frame."""

    kind: Literal["given"] = "given"
    position_m: Vector[Place] = key("position of the object in the cell frame", example=ZERO)
    rotation_rad: Vector[Angle] = key("orientation of the object, a rotation vector", example=ZERO)


class EmulatedTrackerEntry(_TrackerEntry):
    """Camera of the emulated cell."""

    kind: Literal["emulated"] = "emulated"
    noise_m: float = key("standard deviation of measured positions", 0.0, low=0, high=0.1)
    noise_rad: float = key("standard deviation of measured orientations", 0.0, low=0, high=0.5)
    delay_s: float = key("age of a measured pose", 0.0, low=0, high=0.499)


class OwnTrackerEntry(_TrackerEntry):
    """Tracker of your own: a subclass of `ObjectTracker`, made with the name of the object and the options."""

    kind: Literal["own"] = "own"
    tracker: ClassName = key("class of the tracker", example="my_lab.camera:Camera")
    options: Options = key(_OPTIONS, "")


MAX_TRACKERS: Final = 20

Tracker = Annotated[
    AttachedTrackerEntry | GivenTrackerEntry | EmulatedTrackerEntry | OwnTrackerEntry, Field(discriminator="kind")
]


CameraName = Annotated[
    str,
    _text(
        "the name of a camera, such as front or left/wrist, in quotes",
        pattern=r"^[A-Za-z]\w{0,39}(/[A-Za-z]\w{0,39})?$",
    ),
]
BodyName = Annotated[str, _text("the name of a body, in quotes", pattern="^[A-Za-z0-9_/-]{0,100}$")]
Device = Annotated[str, _text("the path of a device, in quotes", pattern="^/dev/[A-Za-z0-9_./:-]{1,100}$")]
_WIDEST_RAD: Final = math.radians(170)


class _CameraEntry(Table):
    name: CameraName = key("name of the camera, as environments have it", example="front")
    position_m: Vector[Coordinate] | None = key(
        "position in the frame of its body; with it, the simulated camera of that name stands there, too",
        None,
        example=(1.8, 0.0, 1.0),
    )
    target_m: Vector[Coordinate] | None = key(
        "point in the middle of the image, in that frame", None, example=(-0.4, 0.0, 0.3)
    )
    up: Vector[Annotated[float, Field(ge=-1, le=1)]] | None = key(
        "direction in that frame that is upwards in the images; a missing one is z, or x for a view along z",
        None,
        example=(0.0, 0.0, 1.0),
    )
    fovy_rad: float = key("vertical field of view", math.pi / 4, low=0.02, high=_WIDEST_RAD)
    body: BodyName = key("body that carries it; empty: it stands in the cell frame", "", example="left/gripper")

    @property
    def mounted(self) -> Camera | None:
        """Camera of the scene that stands where this one does; None: its pose is not stated.

        Raises:
            SettingsError: The pose is not possible.
        """
        if self.position_m is None or self.target_m is None:
            return None
        last = self.name.rpartition("/")[2]
        return Camera(last, self.position_m, self.target_m, math.degrees(self.fovy_rad), self.body, self.up)


class _PacedCameraEntry(_CameraEntry):
    rate_hz: float = key("images per second", 30.0, low=0.1, high=240)


class _SizedCameraEntry(_PacedCameraEntry):
    width: int = key("width of its images in pixels", 640, low=16, high=1920)
    height: int = key("height of its images in pixels", 480, low=16, high=1080)


class FileCameraEntry(_CameraEntry):
    """Video file, played at its own rate."""

    kind: Literal["file"] = "file"
    file: FileName = key("path of the video", example="front.mp4")
    repeat: bool = key("whether it begins again at its end, which otherwise counts as the loss of the camera", False)


class PatternCameraEntry(_PacedCameraEntry):
    """Test images, which show the time of their exposure."""

    kind: Literal["pattern"] = "pattern"


class EmulatedCameraEntry(_PacedCameraEntry):
    """Camera in the world of the emulated cell."""

    kind: Literal["emulated"] = "emulated"


class V4l2CameraEntry(_SizedCameraEntry):
    """Camera of Linux (Video4Linux2), such as one at USB."""

    kind: Literal["v4l2"] = "v4l2"
    device: Device = key("its device", example="/dev/video0")
    format: Literal["mjpeg", "yuyv422"] = key("format in which it sends images", "mjpeg")
    delay_s: float = key("time from the exposure to the time stamp of the driver", 0.0, low=0, high=0.5)


class OwnCameraEntry(_SizedCameraEntry):
    """Camera of your own: a subclass of `CameraSource`, made with a `CameraRequest` and the options."""

    kind: Literal["own"] = "own"
    camera: ClassName = key("class of the camera", example="my_lab.camera:Industrial")
    options: Options = key(_OPTIONS, "")


MAX_CAMERAS: Final = 16

CameraEntry = Annotated[
    FileCameraEntry | PatternCameraEntry | EmulatedCameraEntry | V4l2CameraEntry | OwnCameraEntry,
    Field(discriminator="kind"),
]


_OBSTACLES: Final[dict[str, type[obstacles.Obstacle]]] = {
    "box": obstacles.Box,
    "capsule": obstacles.Capsule,
    "plane": obstacles.Plane,
}


class _ObstacleEntry(Table):
    kind: str
    name: Name = key("name of the obstacle", example="wall")

    @property
    def obstacle(self) -> obstacles.Obstacle:
        """The obstacle as scenes take it."""
        return _OBSTACLES[self.kind](**self.model_dump(exclude={"kind"}))


class BoxEntry(_ObstacleEntry):
    """Box."""

    kind: Literal["box"] = "box"
    position_m: Vector[Coordinate] = key("position of the centre", example=ZERO)
    size_m: Vector[Annotated[float, Field(ge=obstacles.THINNEST_M, le=_ROOM_M)]] = key(
        "length of the edges", example=(1, 1, 1)
    )
    rotation_rad: Vector[Angle] = key("orientation, a rotation vector", ZERO)


class CapsuleEntry(_ObstacleEntry):
    """Capsule; a ball if both ends are one point."""

    kind: Literal["capsule"] = "capsule"
    from_m: Vector[Coordinate] = key("one end of the axis", example=ZERO)
    to_m: Vector[Coordinate] = key("other end of the axis", example=(0, 0, 1))
    radius_m: float = key("radius", low=obstacles.THINNEST_M, high=_ROOM_M / 2, example=0.1)


class PlaneEntry(_ObstacleEntry):
    """Infinite plane."""

    kind: Literal["plane"] = "plane"
    point_m: Vector[Coordinate] = key("a point of the plane", example=(1, 0, 0))
    normal: Vector[Annotated[float, Field(ge=-1.001, le=1.001)]] = key(
        "direction towards the arms", note="of length 1", example=(-1, 0, 0)
    )


ObstacleEntry = Annotated[BoxEntry | CapsuleEntry | PlaneEntry, Field(discriminator="kind")]
