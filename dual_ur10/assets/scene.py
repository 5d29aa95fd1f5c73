"""The cell: two UR10s as ``left/`` and ``right/``, a table between them, floor, lights and cameras.

[compose][dual_ur10.assets.scene.compose] writes the MJCF of a cell and
[compose_clearance][dual_ur10.assets.scene.compose_clearance] that of its contact-free twin, which only measures the
distances between collision capsules. Both are cached per settings; the models built from them are fresh each time, so
that a caller may change one. Importing this module loads neither mujoco nor dm_control.

Cell frame: origin on the table top midway between the arms' workspaces, x forward (away from the bases), y left, z up.
"""

from __future__ import annotations

import importlib.metadata
import math
import warnings
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dual_ur10.errors import DualUR10Error, MissingExtraError, SettingsError, UnknownNameError
from dual_ur10.ur10 import ARMS, JOINTS, LINKS, NOMINAL_DH, Array, DHParameters

if TYPE_CHECKING:
    import mujoco  # type: ignore[import-untyped, unused-ignore]

GAINS: Final[dict[str, tuple[tuple[float, ...], tuple[float, ...]]]] = {
    "stiff": ((20000.0, 20000.0, 10000.0, 3000.0, 3000.0, 3000.0), (1000.0, 1000.0, 500.0, 60.0, 60.0, 60.0)),
    "compliant": ((4000.0, 4000.0, 3500.0, 3200.0, 3200.0, 3200.0), (350.0, 350.0, 200.0, 30.0, 30.0, 30.0)),
}
"""kp in N·m/rad and kv in N·m·s/rad per joint: "stiff" for free motion, "compliant" where both arms hold one thing."""

CAMERAS: Final = ("front", "side", "overhead", "perspective")
"""Names of the fixed cameras; each shows both arms."""

CLEARANCE_CUTOFF_M: Final = 0.2
"""Distances beyond this read as this."""

TABLE_THICKNESS_M: Final = 0.06
FLOOR_Z_M: Final = -0.75
BASE_RADIUS_M: Final = 0.15
"""Room around a base's axis that its turning shoulder takes."""

MIN_BASE_DISTANCE_M: Final = 0.3

_MAX_MOUNT_M: Final = 3.0
_ARM_FILE: Final = Path(__file__).with_name("ur10") / "ur10.xml"


def _home() -> Array:
    # Elbow up, tool z straight down, flange x towards the base: the rotation vector (pi, 0, 0) in UR's base frame.
    posture = [-0.22036724, -1.4126697, 1.84438035, -2.00250698, -math.pi / 2, 1.35042908]
    home = np.array([posture, posture])
    home.setflags(write=False)
    return home


HOME_Q_RAD: Final = _home()
"""(2, 6) rad: flanges 0.75 m in front of the bases and 0.4 m above them, at (0, ±0.6, 0.4) with default mounts."""


@dataclass(frozen=True)
class ArmMount:
    """Where one arm stands.

    Attributes:
        position_m: (3,) position of `base_link` in the cell frame.
        yaw_rad: turn of `base_link` about the cell's z axis; 0 looks along +x.
        dh: kinematics of this arm, nominal or as calibrated.

    Raises:
        SettingsError: A number is not finite, more than 3 m from the cell's origin, below the floor, or beyond ±2π.
    """

    position_m: tuple[float, float, float]
    yaw_rad: float = 0.0
    dh: DHParameters = NOMINAL_DH

    def __post_init__(self) -> None:
        position = _numbers("mount position_m", self.position_m, 3)
        (yaw,) = _numbers("mount yaw_rad", (self.yaw_rad,), 1)
        if max(map(abs, position)) > _MAX_MOUNT_M or position[2] < FLOOR_Z_M:
            raise SettingsError(
                f"mount position_m is {position}: each coordinate must be within ±{_MAX_MOUNT_M} m and z not below "
                f"the floor at {FLOOR_Z_M} m"
            )
        if abs(yaw) > 2 * math.pi:
            raise SettingsError(f"mount yaw_rad is {yaw:.6g}: must be within ±2π (radians, not degrees)")
        if not isinstance(self.dh, DHParameters):
            raise SettingsError(f"mount dh must be DHParameters, found {type(self.dh).__name__}")
        object.__setattr__(self, "position_m", position)
        object.__setattr__(self, "yaw_rad", yaw)


@dataclass(frozen=True)
class SceneSettings:
    """What stands in the cell and how it is simulated.

    Attributes:
        left: mount of the left arm.
        right: mount of the right arm.
        timestep_s: physics timestep.
        gains: one of [GAINS][dual_ur10.assets.scene.GAINS].
        meshes: draw the meshes of the optional package `example-robot-data` in place of primitives. Looks only.
        table_center_m: (2,) x, y of the table's centre; its top is at z = 0.
        table_size_m: (2,) length along x and width along y.

    Raises:
        SettingsError: A number is not finite or out of range, the bases stand closer than 0.3 m to each other, or a
            base stands inside the table.
        UnknownNameError: `gains` is no name of a gain set.
    """

    left: ArmMount = field(default_factory=lambda: ArmMount((-0.75, 0.6, 0.0)))
    right: ArmMount = field(default_factory=lambda: ArmMount((-0.75, -0.6, 0.0)))
    timestep_s: float = 0.002
    gains: str = "stiff"
    meshes: bool = False
    table_center_m: tuple[float, float] = (0.0, 0.0)
    table_size_m: tuple[float, float] = (1.0, 1.8)

    def __post_init__(self) -> None:
        (timestep,) = _numbers("timestep_s", (self.timestep_s,), 1)
        if not 0.0 < timestep <= 0.02:
            raise SettingsError(f"timestep_s is {timestep:.6g}: must be above 0 and at most 0.02 s")
        if self.gains not in tuple(GAINS):
            raise UnknownNameError("gains", str(self.gains), tuple(GAINS))
        center = _numbers("table_center_m", self.table_center_m, 2)
        size = _numbers("table_size_m", self.table_size_m, 2)
        if min(size) < 0.1 or max(size) > 2 * _MAX_MOUNT_M or max(map(abs, center)) > _MAX_MOUNT_M:
            raise SettingsError(
                f"table of {size} m at {center} m: sides must be 0.1 to {2 * _MAX_MOUNT_M} m long and the centre "
                f"within ±{_MAX_MOUNT_M} m"
            )
        object.__setattr__(self, "timestep_s", timestep)
        object.__setattr__(self, "table_center_m", center)
        object.__setattr__(self, "table_size_m", size)
        self._check_bases()

    @property
    def mounts(self) -> tuple[ArmMount, ArmMount]:
        """Both mounts in the order of [ARMS][dual_ur10.ur10.ARMS]."""
        return self.left, self.right

    def _check_bases(self) -> None:
        for arm, mount in zip(ARMS, self.mounts, strict=True):
            if not isinstance(mount, ArmMount):
                raise SettingsError(f"{arm} must be an ArmMount, found {type(mount).__name__}")
        distance = math.dist(self.left.position_m, self.right.position_m)
        if distance < MIN_BASE_DISTANCE_M:
            raise SettingsError(
                f"the bases are {distance:.3f} m apart: two UR10s need at least {MIN_BASE_DISTANCE_M} m between them"
            )
        for arm, mount in zip(ARMS, self.mounts, strict=True):
            if self._inside_table(mount):
                raise SettingsError(
                    f"the {arm} base at {mount.position_m} m stands inside the table: move it, shrink the table, "
                    f"or put it on the table top (z >= 0)"
                )

    def _inside_table(self, mount: ArmMount) -> bool:
        outside = [
            max(0.0, abs(p - c) - s / 2)
            for p, c, s in zip(mount.position_m, self.table_center_m, self.table_size_m, strict=False)
        ]
        # An arm mounted below the top would have to grow through the table, so all heights below it count.
        return math.hypot(*outside) < BASE_RADIUS_M and mount.position_m[2] < 0.0


def _numbers(name: str, values: Any, length: int) -> tuple[Any, ...]:
    """Plain finite floats, so that equal settings hash alike."""
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != length or not all(map(math.isfinite, numbers)):
        raise SettingsError(f"{name} must be {length} finite number{'s' * (length > 1)}, found {values!r}")
    return numbers


# Which parts of one arm can meet. Joints 2, 3 and 4 are parallel, so wrists 1 and 2 always pass base and shoulder
# sideways; ur10.xml filters their contacts.
_OWN: Final = {
    "forearm_link": ("base_link", "shoulder_link"),
    "wrist_1_link": ("upper_arm_link",),
    "wrist_2_link": ("upper_arm_link",),
    "wrist_3_link": ("base_link", "shoulder_link", "upper_arm_link", "forearm_link"),
}


def _pairs() -> tuple[tuple[str, str], ...]:
    moving = LINKS[1:]
    pairs = [(f"left/{a}", f"right/{b}") for a in moving for b in moving]
    for arm, other_arm in (ARMS, ARMS[::-1]):
        pairs += [(f"{arm}/{link}", f"{other_arm}/{other}") for link in moving for other in ("base_link", LINKS[0])]
        pairs += [(f"{arm}/{link}", ground) for link in moving for ground in ("table", "floor")]
        pairs += [(f"{arm}/{link}", f"{arm}/{other}") for link, others in _OWN.items() for other in others]
    return tuple(pairs)


CLEARANCE_PAIRS: Final = _pairs()
"""Geom names of each distance sensor of the clearance model, in sensor order."""


def clearance_pairs() -> tuple[tuple[str, str], ...]:
    """Geom names of each distance sensor of the clearance model, in sensor order.

    The pairs are all that can meet: each moving link with the other arm, the table and the floor, and the forearm and
    the wrists with those parts of their own arm that they can reach.
    """
    return CLEARANCE_PAIRS


@lru_cache(maxsize=32)
def compose(settings: SceneSettings, *, drawn: bool = True) -> str:
    """MJCF text of the whole cell.

    Joints, actuators and degrees of freedom come as the left arm's six, then the right arm's six. The sensors are, for
    left and then right each time: `<arm>/flange_base_pos` and `<arm>/flange_base_quat` (flange in the arm's own UR
    `base` frame, m and w, x, y, z) and `<arm>/flange_pos` (flange in the cell frame, m).

    Args:
        settings: the cell.
        drawn: with the parts that are only looked at. Without them the model has the same state and the same
            dynamics, and a step costs two thirds: simulate without, draw with.

    Returns:
        The text; the same object for equal settings.

    Raises:
        MissingExtraError: `settings.meshes` is set and `example-robot-data` is not installed.
    """
    root = _tree(settings)
    if drawn:
        _add_surroundings(root, settings)
    else:
        for arm in ARMS:
            _strip(root.find("attachment_frame", arm))
    document = _document(root)
    _add_flange_sensors(document)
    if settings.meshes and drawn:
        _use_meshes(document)
    return _text(document)


@lru_cache(maxsize=32)
def compose_clearance(settings: SceneSettings) -> str:
    """MJCF text of the cell's twin that measures distances: capsules, table and floor, one sensor per pair.

    It has the cell's joints in the cell's order and no visuals, contacts, actuators or gravity, so that one `forward`
    up to the position stage gives all distances. Sensor i is the signed distance in m of
    `clearance_pairs()[i]`, negative when they overlap, at most `CLEARANCE_CUTOFF_M`.

    Args:
        settings: the cell; `gains` and `meshes` do not matter.

    Returns:
        The text; the same object for equal settings.
    """
    root = _tree(settings)
    for arm in ARMS:
        _strip(root.find("attachment_frame", arm))
    for actuator in root.find_all("actuator"):
        actuator.remove()
    for name in ("contact", "gravity", "constraint", "actuation"):
        setattr(root.option.flag, name, "disable")
    document = _document(root)
    sensors = _child(document, "sensor")
    for geom1, geom2 in CLEARANCE_PAIRS:
        ET.SubElement(
            sensors,
            "distance",
            name=f"{geom1}:{geom2}",
            geom1=geom1,
            geom2=geom2,
            cutoff=repr(CLEARANCE_CUTOFF_M),
        )
    return _text(document)


def build_model(settings: SceneSettings, *, drawn: bool = True) -> mujoco.MjModel:
    """A fresh model of the cell.

    Args:
        settings: the cell.
        drawn: with the parts that are only looked at; see `compose`.

    Returns:
        The compiled model; the caller may change it.

    Raises:
        MissingExtraError: `settings.meshes` is set and `example-robot-data` is not installed.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(compose(settings, drawn=drawn))
    _check_order([model.joint(i).name for i in range(model.njnt)], "joints")
    _check_order([model.actuator(i).name for i in range(model.nu)], "actuators")
    return model


def build_clearance_model(settings: SceneSettings) -> mujoco.MjModel:
    """A fresh model of the cell's contact-free twin, for distances only.

    Args:
        settings: the cell.

    Returns:
        The compiled model; its `sensordata` has one distance per pair of `clearance_pairs()`.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(compose_clearance(settings))
    _check_order([model.joint(i).name for i in range(model.njnt)], "joints")
    return model


def sensor_slices(model: mujoco.MjModel) -> dict[str, slice]:
    """Where each named sensor's values lie in `sensordata`."""
    return {
        model.sensor(i).name: slice(int(model.sensor_adr[i]), int(model.sensor_adr[i]) + int(model.sensor_dim[i]))
        for i in range(model.nsensor)
    }


def _check_order(names: list[str], kind: str) -> None:
    expected = [f"{arm}/{joint}" for arm in ARMS for joint in JOINTS]
    if names != expected:
        raise DualUR10Error(f"the model's {kind} are {names}, expected {expected}: ur10.xml and ur10.py disagree")


def _mjcf() -> Any:
    """dm_control's composer, imported late: it is heavy and tries every OpenGL backend."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # GLFW complains where there is no display; nothing is drawn here
        from dm_control import mjcf  # type: ignore[import-untyped, unused-ignore]
    return mjcf


def _tree(settings: SceneSettings) -> Any:
    """dm_control tree with what both models share: options, floor, table and both arms."""
    mjcf = _mjcf()
    root = mjcf.RootElement(model="cell")
    root.compiler.angle = "radian"
    root.option.timestep = settings.timestep_s
    root.option.integrator = "implicitfast"
    root.option.cone = "elliptic"
    # A diverged simulation must be seen by the caller, not silently start again from t = 0.
    root.option.flag.autoreset = "disable"
    _add_ground(root, settings)
    for name, mount in zip(ARMS, settings.mounts, strict=True):
        arm = mjcf.from_path(str(_ARM_FILE))
        arm.model = name
        _apply_dh(arm, mount.dh)
        for joint, kp, kv in zip(JOINTS, *GAINS[settings.gains], strict=True):
            actuator = arm.find("actuator", joint)
            actuator.kp, actuator.kv = kp, kv
        frame = root.attach(arm)
        frame.pos = mount.position_m
        frame.quat = _quat_z(mount.yaw_rad)
    return root


def _add_ground(root: Any, settings: SceneSettings) -> None:
    (x, y), (length, width) = settings.table_center_m, settings.table_size_m
    root.worldbody.add("geom", name="floor", type="plane", pos=(0, 0, FLOOR_Z_M), size=(6, 6, 0.1))
    root.worldbody.add(
        "geom",
        name="table",
        type="box",
        pos=(x, y, -TABLE_THICKNESS_M / 2),
        size=(length / 2, width / 2, TABLE_THICKNESS_M / 2),
    )


def _quat_z(angle_rad: float) -> tuple[float, float, float, float]:
    return math.cos(angle_rad / 2), 0.0, 0.0, math.sin(angle_rad / 2)


def _apply_dh(arm: Any, dh: DHParameters) -> None:
    """Move the bodies of one arm to the frames of its own DH parameters, exactly.

    A calibration may shift d2, d3 and d4 by metres against each other, for joints 2 to 4 are nearly parallel. Sliding
    the frames of forearm and wrist 1 along their own joint axes back to where the links are leaves the kinematics as
    they are.
    """
    if dh.is_nominal:
        return  # the file holds the nominal arm
    slide = np.zeros(7)
    slide[2] = -dh.d_m[1] / math.cos(dh.alpha_rad[1])
    slide[3] = (slide[2] - dh.d_m[2]) / math.cos(dh.alpha_rad[2])
    nominal, corrected = _link_ends(NOMINAL_DH, np.zeros(7)), _link_ends(dh, slide)
    shoulder = arm.find("body", LINKS[0])
    shoulder.quat = _quat_product((0.0, 0.0, 0.0, 1.0), _quat_z(dh.theta_rad[0]))
    for i, link in enumerate(LINKS):
        body = arm.find("body", link)
        position, twist = corrected[i]
        if i < 5:
            child = arm.find("body", LINKS[i + 1])
            child.pos, child.quat = position, _quat_product(twist, _quat_z(dh.theta_rad[i + 1]))
        else:
            site = arm.find("site", "flange")
            site.pos, site.quat = position, twist
        _move_inertia(body.inertial, nominal[i], corrected[i])


_Pose = tuple[Array, tuple[float, float, float, float]]


def _link_ends(dh: DHParameters, slide: Array) -> list[_Pose]:
    """Pose of each link's distal frame in its body frame: position in m, quaternion w, x, y, z.

    Args:
        dh: kinematics of the arm.
        slide: (7,) m, how far each body frame is moved along its own joint axis.
    """
    poses: list[_Pose] = []
    for i in range(6):
        alpha = dh.alpha_rad[i]
        position = np.array(
            [
                dh.a_m[i],
                -math.sin(alpha) * slide[i + 1],
                dh.d_m[i] - slide[i] + math.cos(alpha) * slide[i + 1],
            ]
        )
        poses.append((position, (math.cos(alpha / 2), math.sin(alpha / 2), 0.0, 0.0)))
    return poses


def _move_inertia(inertial: Any, old: _Pose, new: _Pose) -> None:
    """Carry an inertia along with the distal frame it is given in."""
    rotation = _matrix(new[1]) @ _matrix(old[1]).T
    ixx, iyy, izz, ixy, ixz, iyz = inertial.fullinertia
    inertia = rotation @ np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]) @ rotation.T
    inertial.pos = new[0] + rotation @ (inertial.pos - old[0])
    inertial.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _quat_product(
    a: tuple[float, float, float, float], b: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _matrix(quat: tuple[float, float, float, float]) -> Array:
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _strip(frame: Any) -> None:
    """Take the drawn parts off one arm."""
    for geom in frame.find_all("geom"):
        if geom.dclass is not None and geom.dclass.dclass == "visual":
            geom.remove()


def _add_surroundings(root: Any, settings: SceneSettings) -> None:
    """Everything that is only looked at: materials, sky, lights, cameras, table legs, pedestals."""
    root.statistic.center = (-0.2, 0.0, 0.25)
    root.statistic.extent = 1.6
    getattr(root.visual, "global").offwidth = 1920
    getattr(root.visual, "global").offheight = 1080
    root.visual.headlight.ambient = (0.35, 0.35, 0.35)
    root.visual.headlight.diffuse = (0.25, 0.25, 0.25)
    root.visual.headlight.specular = (0.1, 0.1, 0.1)
    root.visual.quality.shadowsize = 4096
    root.visual.map.znear = 0.02
    _add_materials(root)
    for position, strength, shadow in (((0.6, 0.9, 3.5), 0.5, "true"), ((-1.0, -2.5, 3.0), 0.3, "false")):
        root.worldbody.add(
            "light",
            pos=position,
            dir=(-0.2 - position[0], -position[1], 0.2 - position[2]),
            cutoff=60,
            exponent=1,
            diffuse=(strength,) * 3,
            specular=(0.2,) * 3,
            castshadow=shadow,
        )
    for name, position, target in (
        ("front", (1.8, 0.0, 1.0), (-0.4, 0.0, 0.3)),
        ("side", (-0.1, -2.6, 0.9), (-0.25, 0.0, 0.3)),
        ("overhead", (-0.25, 0.0, 3.2), (-0.2, 0.0, 0.0)),
        ("perspective", (1.4, -1.7, 1.35), (-0.35, 0.0, 0.25)),
    ):
        root.worldbody.add("camera", name=name, pos=position, xyaxes=_look(position, target), fovy=45)
    _add_furniture(root, settings)


def _look(position: tuple[float, float, float], target: tuple[float, float, float]) -> list[float]:
    """Axes x and y of a camera that looks from one point to another, the cell's z (or x, from above) upwards."""
    backward = np.subtract(position, target)
    backward /= np.linalg.norm(backward)
    up = np.array([0.0, 0.0, 1.0]) if abs(backward[2]) < 0.95 else np.array([1.0, 0.0, 0.0])
    x = np.cross(up, backward)
    x /= np.linalg.norm(x)
    return [*x.tolist(), *np.cross(backward, x).tolist()]


def _add_materials(root: Any) -> None:
    asset = root.asset
    asset.add(
        "texture",
        name="sky",
        type="skybox",
        builtin="gradient",
        rgb1=(0.75, 0.82, 0.9),
        rgb2=(0.35, 0.42, 0.5),
        width=256,
        height=256,
    )
    asset.add(
        "texture",
        name="floor",
        type="2d",
        builtin="checker",
        rgb1=(0.42, 0.44, 0.46),
        rgb2=(0.38, 0.40, 0.42),
        width=256,
        height=256,
    )
    asset.add("material", name="floor", texture="floor", texrepeat=(1, 1), texuniform="true")
    asset.add("material", name="table_top", rgba=(0.62, 0.55, 0.45, 1), specular=0.1, shininess=0.2)
    asset.add("material", name="frame", rgba=(0.25, 0.27, 0.29, 1), specular=0.3, shininess=0.4)
    root.find("geom", "floor").material = "floor"
    root.find("geom", "table").material = "table_top"


def _add_furniture(root: Any, settings: SceneSettings) -> None:
    look = {"material": "frame", "contype": 0, "conaffinity": 0, "group": 2}
    (x, y), (length, width) = settings.table_center_m, settings.table_size_m
    height = -TABLE_THICKNESS_M - FLOOR_Z_M
    for sx in (-1, 1):
        for sy in (-1, 1):
            root.worldbody.add(
                "geom",
                type="box",
                pos=(x + sx * (length / 2 - 0.06), y + sy * (width / 2 - 0.06), FLOOR_Z_M + height / 2),
                size=(0.04, 0.04, height / 2),
                **look,
            )
    for mount in settings.mounts:
        px, py, pz = mount.position_m
        on_table = abs(px - x) < length / 2 and abs(py - y) < width / 2 and pz >= 0.0
        bottom = 0.0 if on_table else FLOOR_Z_M
        if pz - bottom < 0.05:
            continue  # the base stands on the table or on the floor itself
        for top, low, radius in ((pz, pz - 0.02, 0.13), (pz - 0.02, bottom, 0.09), (bottom + 0.02, bottom, 0.2)):
            root.worldbody.add(
                "geom",
                type="cylinder",
                pos=(px, py, (top + low) / 2),
                size=(radius, (top - low) / 2),
                **look,
            )


def _document(root: Any) -> ET.Element:
    return ET.fromstring(root.to_xml_string())


def _child(parent: ET.Element, tag: str) -> ET.Element:
    found = parent.find(tag)
    return ET.SubElement(parent, tag) if found is None else found


def _text(document: ET.Element) -> str:
    ET.indent(document)
    return ET.tostring(document, encoding="unicode")


def _add_flange_sensors(document: ET.Element) -> None:
    # Here and not in the dm_control tree: that one sorts sensors by arm and lets no name hold a slash.
    sensors = _child(document, "sensor")
    for tag, suffix, relative in (
        ("framepos", "flange_base_pos", True),
        ("framequat", "flange_base_quat", True),
        ("framepos", "flange_pos", False),
    ):
        for arm in ARMS:
            attributes = {"name": f"{arm}/{suffix}", "objtype": "site", "objname": f"{arm}/flange"}
            if relative:
                attributes |= {"reftype": "site", "refname": f"{arm}/base"}
            ET.SubElement(sensors, tag, attributes)


# Frames of the mesh files in the body frames of ur10.xml: position in m, quaternion w, x, y, z.
_HALF = math.sqrt(0.5)
_MESHES: Final = {
    "base_link": ("base", "0 0 0", "1 0 0 0"),
    "shoulder_link": ("shoulder", "0 0 0.1273", "0 0 0 1"),
    "upper_arm_link": ("upperarm", "0 0 0.220941", "0.5 0.5 -0.5 -0.5"),
    "forearm_link": ("forearm", "0 0 0.049041", "0.5 0.5 -0.5 -0.5"),
    "wrist_1_link": ("wrist1", "0 0 0.049041", f"{_HALF} {_HALF} 0 0"),
    "wrist_2_link": ("wrist2", "0 0 0", "1 0 0 0"),
    "wrist_3_link": ("wrist3", "0 0 0", f"{_HALF} {_HALF} 0 0"),
}


def _mesh_folder() -> Path:
    where = "cmeel.prefix/share/example-robot-data/robots/ur_description/meshes/ur10/collision"
    try:
        folder = Path(str(importlib.metadata.distribution("example-robot-data").locate_file(where)))
    except importlib.metadata.PackageNotFoundError:
        folder = Path()
    if not (folder / "base.stl").is_file():
        raise MissingExtraError("example-robot-data", "meshes", "drawing the UR10's meshes (meshes=True)")
    return folder


def _use_meshes(document: ET.Element) -> None:
    """Draw meshes in place of the primitives of both arms."""
    folder = _mesh_folder()
    asset = _child(document, "asset")
    for mesh, _, _ in _MESHES.values():
        ET.SubElement(asset, "mesh", name=mesh, file=str(folder / f"{mesh}.stl"))
    for arm in ARMS:
        for link, (mesh, position, quat) in _MESHES.items():
            body = document.find(f".//body[@name='{arm}/{link}']")
            if body is None:
                raise DualUR10Error(f"ur10.xml has no body {link!r}")
            for geom in body.findall(f"geom[@class='{arm}/visual']"):
                body.remove(geom)
            ET.SubElement(
                body,
                "geom",
                {"class": f"{arm}/visual"},
                type="mesh",
                mesh=mesh,
                pos=position,
                quat=quat,
                material=f"{arm}/tube",
            )
