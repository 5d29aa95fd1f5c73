"""Settings and constants of the scene: mounts, table, equipment and obstacles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np

from dual_ur10.assets.obstacles import Obstacle, checked
from dual_ur10.assets.prop import Prop, check_props
from dual_ur10.errors import SettingsError
from ur_core.kinematics.frames import MAX_MOUNT_M, ArmMount, finite_floats
from ur_core.kinematics.home import FRONT_M, home_of, reach_ratio
from ur_core.kinematics.robots import ROBOTS
from ur_core.kinematics.ur10 import ARMS
from ur_core.mjcf.camera import Camera, cameras_of
from ur_core.mjcf.gains import STIFF, Gains, check_gains, check_integrator
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85
from ur_core.tools.tool import Tool, tools_of
from ur_core.types import Array, constant

TABLE_THICKNESS_M: Final = 0.06
BASE_RADIUS_M: Final = 0.15
"""Radius around a base's axis that its rotating shoulder occupies."""

MIN_BASE_DISTANCE_M: Final = 0.3

DEFAULT_TOOLS: Final = (ROBOTIQ_2F85, ROBOTIQ_2F85)
"""Tools of both arms where neither task nor cell names others."""

HOME_Q_RAD: Final = constant([home_of("ur10"), home_of("ur10")])
"""(2, 6) rad, of two UR10s: flanges 0.75 m in front of the bases and 0.4 m above them, at (0, ±0.6, 0.4) with default
mounts."""

_SIDE_M: Final = 0.6


def home_q_rad(mounts: Sequence[ArmMount]) -> Array:
    """Return the home configuration of both arms, (2, 6); with default mounts the flanges are at (0, ±0.6, 0.4).

    Args:
        mounts: Mounts of both arms.
    """
    return np.array([home_of(mount.robot) for mount in mounts])


@lru_cache(maxsize=2 * len(ROBOTS))
def default_mount(arm: int, robot: str = "ur10") -> ArmMount:
    """Return the default mount of an arm, the same object at every call: a shorter arm stands nearer to the workspace.

    Args:
        arm: Index of the arm in `ARMS`.
        robot: Its model.

    Raises:
        UnknownNameError: There is no such model.
    """
    return ArmMount((-FRONT_M * reach_ratio(robot), _SIDE_M * (1 - 2 * arm), 0.0), robot=robot)


@dataclass(frozen=True)
class Equipment:
    """Equipment of both arms.

    Attributes:
        grippers: A parallel-jaw gripper on each flange.
        props: Objects and fixtures; see `dual_ur10.assets.prop.Prop`.
        welds: Pairs of sites, of a gripper ("left/tcp") and of a prop ("bar/left_grip"), that are welded to each other,
            instead of held by friction.
        grip_force_n: Force with which each finger presses.
        tools: Tools of the left and the right arm, as `Tool` or by name.
        cameras: Further cameras, in the cell or on any of its bodies.

    Raises:
        UnknownNameError: There is no tool of a name.
        SettingsError: `grippers` is not True or False, props, welds or cameras are none or clash, or a tool has no such
            force.
    """

    grippers: bool = False
    props: tuple[Prop, ...] = ()
    welds: tuple[tuple[str, str], ...] = ()
    grip_force_n: float = 60.0
    tools: tuple[Tool, Tool] = DEFAULT_TOOLS
    cameras: tuple[Camera, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.grippers, bool):
            raise SettingsError(f"grippers must be True or False, found {self.grippers!r}")
        object.__setattr__(self, "props", check_props(self.props))
        object.__setattr__(self, "welds", tuple((str(a), str(b)) for a, b in self.welds))
        names = {each.name for each in self.props}
        for site, other in self.welds:
            if not self.grippers or site not in [f"{arm}/tcp" for arm in ARMS] or other.split("/")[0] not in names:
                raise SettingsError(
                    f"welds has {site!r} with {other!r}, with grippers={self.grippers}: each is of a gripper's tool, "
                    f"{' or '.join(f'{arm}/tcp' for arm in ARMS)}, and a site of a prop, such as bar/left_grip; the "
                    f"props are {', '.join(sorted(names)) or 'none'}"
                )
        object.__setattr__(self, "cameras", cameras_of(self.cameras, "the scene"))
        (force,) = finite_floats("grip_force_n", (self.grip_force_n,), 1)
        object.__setattr__(self, "tools", tools_of(self.tools))
        for tool in self.tools if self.grippers else DEFAULT_TOOLS:
            if not tool.force_n[0] <= force <= tool.force_n[1]:
                raise SettingsError(
                    f"grip_force_n is {force:.6g}: must be within {tool.force_n[0]:.0f} to {tool.force_n[1]:.0f} N, as "
                    f"the tool {tool.name!r} has them"
                )
        object.__setattr__(self, "grip_force_n", force)

    @property
    def welded(self) -> bool:
        """True if grippers are welded to a prop."""
        return bool(self.welds)


@dataclass(frozen=True)
class SceneSettings:
    """Content of the cell and settings of its simulation.

    Attributes:
        left: Mount of the left arm.
        right: Mount of the right arm.
        timestep_s: Physics timestep.
        integrator: One of [INTEGRATORS][ur_core.mjcf.gains.INTEGRATORS].
        gains: Gains of the joint servos.
        meshes: Render the meshes of the optional package `example-robot-data` in place of primitives. Visual only.
        table_center_m: (2,) x, y of the table's centre; its top is at z = 0.
        table_size_m: (2,) length along x and width along y.
        equipment: Grippers, and the props to handle.
        obstacles: Further bodies: [obstacles][dual_ur10.assets.obstacles], with different names.
        cameras: Cameras of the cell by their names, each in place of the one of that name or a further one.

    Raises:
        SettingsError: A number is not finite or out of range, obstacles have the same name, the bases stand closer than
            0.3 m to each other, a base stands inside the table, `gains` is none, or the integrator is unstable.
        UnknownNameError: `integrator` is no integrator.
    """

    left: ArmMount = field(default_factory=lambda: default_mount(0))
    right: ArmMount = field(default_factory=lambda: default_mount(1))
    timestep_s: float = 0.002
    integrator: str = "implicitfast"
    gains: Gains = STIFF
    meshes: bool = False
    table_center_m: tuple[float, float] = (0.0, 0.0)
    table_size_m: tuple[float, float] = (1.0, 1.8)
    equipment: Equipment = Equipment()
    obstacles: tuple[Obstacle, ...] = ()
    cameras: tuple[tuple[str, Camera], ...] = ()

    def __post_init__(self) -> None:
        (timestep,) = finite_floats("timestep_s", (self.timestep_s,), 1)
        if not 0.0 < timestep <= 0.02:
            raise SettingsError(f"timestep_s is {timestep:.6g}: must be above 0 and at most 0.02 s")
        check_gains(self.gains)
        self._check_mounts()
        check_integrator(self.integrator, self.gains, timestep, robots=self.robots)
        center = finite_floats("table_center_m", self.table_center_m, 2)
        size = finite_floats("table_size_m", self.table_size_m, 2)
        if min(size) < 0.1 or max(size) > 2 * MAX_MOUNT_M or max(map(abs, center)) > MAX_MOUNT_M:
            raise SettingsError(
                f"table of {size} m at {center} m: sides must be 0.1 to {2 * MAX_MOUNT_M} m long and the centre "
                f"within ±{MAX_MOUNT_M} m"
            )
        if not isinstance(self.equipment, Equipment):
            raise SettingsError(f"equipment must be Equipment, found {type(self.equipment).__name__}")
        object.__setattr__(self, "obstacles", checked(self.obstacles))
        object.__setattr__(self, "timestep_s", timestep)
        object.__setattr__(self, "table_center_m", center)
        object.__setattr__(self, "table_size_m", size)
        self._check_bases()

    @property
    def robots(self) -> tuple[str, str]:
        """Models of both arms."""
        return self.left.robot, self.right.robot

    @property
    def mounts(self) -> tuple[ArmMount, ArmMount]:
        """Both mounts in the order of [ARMS][ur_core.kinematics.ur10.ARMS]."""
        return self.left, self.right

    def _check_mounts(self) -> None:
        for arm, mount in zip(ARMS, self.mounts, strict=True):
            if not isinstance(mount, ArmMount):
                raise SettingsError(f"{arm} must be an ArmMount, found {type(mount).__name__}")
        if self.meshes and self.robots != ("ur10", "ur10"):
            raise SettingsError(
                f"meshes=True with {' and '.join(self.robots)}: the package example-robot-data has those of the UR10 "
                "alone. Leave meshes out"
            )

    def _check_bases(self) -> None:
        distance = math.dist(self.left.position_m, self.right.position_m)
        if distance < MIN_BASE_DISTANCE_M:
            raise SettingsError(
                f"the bases are {distance:.3f} m apart: two arms need at least {MIN_BASE_DISTANCE_M} m between them"
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
