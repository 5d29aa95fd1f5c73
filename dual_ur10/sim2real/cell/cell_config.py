"""Configuration of a cell of two arms, and the cell files and hosts that have one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from dual_ur10.assets.collision_model import CLEARANCE_CUTOFF_M
from dual_ur10.assets.obstacles import Obstacle
from dual_ur10.assets.settings import (
    DEFAULT_TOOLS,
    Equipment,
    SceneSettings,
    default_mount,
)
from dual_ur10.errors import RateError, SettingsError, UnknownNameError
from dual_ur10.sim2real.cell.cell_kinds import cell_kind
from dual_ur10.sim2real.cell.perturbation import Perturbation
from dual_ur10.sim2real.control.clearance import MINIMUM_M, checked_base_uncertainty
from dual_ur10.sim2real.control.limits import MotionLimits, checked_tcp
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.robots import MODEL_OF_FAMILY
from ur_core.kinematics.ur10 import ARMS
from ur_core.mjcf.camera import Camera
from ur_core.mjcf.gains import (
    INTEGRATORS,
    MOST_UNSTABLE,
    Gains,
    check_gains,
    check_integrator,
    stability_number,
)
from ur_core.processes.system import System
from ur_core.servoj import DEFAULT_SERVOJ, MEASURED_LOOKAHEAD_S, ServojProfile
from ur_core.tools.tool import Tool, tools_of
from ur_core.types import Vector3, changed

LEAST_DAMPING = 0.3
"""Smallest damping ratio of the servoj law: below it the arms overshoot the targets that the gate checks.

Measured with random actions: with 0.34 and more, true distances stay above 19.7 mm where the targets keep 20 mm. With
0.15 the arms collide, and one is three times as fast as its targets.
"""

LATENCY_S = 0.04
"""Default action latency on two controllers: enough for a policy of 25 ms in Python on a busy machine."""

LEAST_CAP = 0.01
"""Smallest speed cap of a cell, rad/s or m/s."""


class CellSource(Protocol):
    """Cell file from which a configuration was made, as far as the configuration knows it."""

    @property
    def source(self) -> str:
        """Path of the file, for messages."""

    @property
    def emulated_scene(self) -> tuple[str, Mapping[str, Any]] | None:
        """Id of the environment whose scene emulated controllers simulate, and keywords of its task; None: of none."""

    def config(self) -> CellConfig:
        """Return the configuration that the file describes."""

    def text(self) -> str:
        """Return the content of the file."""

    def simulated(self) -> CellConfig:
        """Return the configuration of the same cell in simulation."""


@runtime_checkable
class HostedCell(Protocol):
    """Cell whose controllers run inside this program, such as a `VirtualCell`; a value of the keyword `cell`."""

    @property
    def system(self) -> System:
        """System on which the program and the controllers run."""

    @property
    def file(self) -> CellSource:
        """Cell file."""

    def config(self) -> CellConfig:
        """Return the configuration of the cell."""


@dataclass(frozen=True)
class CellConfig:
    """Configuration of a cell, for `gym.make(..., cell=...)`.

    Attributes:
        kind: "mujoco", the simulated cell; "echo", a dry run, whose state is what was commanded; "emulated" or "real",
            two controllers that a cell file describes; or a name that was registered with
            `dual_ur10.sim2real.cell.cell_kinds.register_cell`.
        left, right: Mount, model and kinematics of each arm. Left out: the model of the other arm, if that is given,
            and otherwise a UR10 or, with controllers of the e-Series, a UR10e. A shorter arm stands nearer to the
            workspace.
        servoj: Controller family and servoj settings of both arms. Left out: those of the arms' family.
        timestep_s: Physics step; it must divide the controller's tick. None: the task's own.
        integrator: Integrator of the physics, a name of `ur_core.mjcf.gains.INTEGRATORS`. None: "Euler" where
            `stability_number` is small, as with the friction grasp of SyncCarry; otherwise "implicitfast".
        gains: Gains of the joint servos in simulation. None: the task's own.
        minimum_clearance_m: Smallest distance between two bodies that the safety gate allows.
        perturbation: Deviation of the simulated plant from the nominal model.
        meshes: Draw real meshes, if the package example-robot-data is installed.
        speed_rad_s: Cap on the joint speed of any task's targets; None: the task's own limit.
        tcp_speed_m_s: Cap on the speed of flange, elbow and tool centre point of any task's targets; None: the task's
            own limit.
        tcp_m: Tool centre point of the left and the right arm in the flange frame; its speed is limited, too. Zeros:
            at the flange.
        acceleration_rad_s2, jerk_rad_s3: Likewise for the joints.
        measured_lookahead_s: Lookahead with which the law of `servoj` moves as both arms do, for the lag compensation;
            None: that of `servoj`.
        speed_factor: Speed of a task's clock on two controllers relative to real time, above 0 and at most 1. Limits
            hold in real time.
        obstacles: Obstacles in the workspace; see `dual_ur10.assets.obstacles`.
        uncertainty: Uncertainty of the pose of each base, (m, rad) for left and right; the clearances that depend on it
            are larger by it.
        file: The cell file of two controllers; None in simulation.
        wrench_noise: Standard deviation of the force (N) and torque (N·m) that simulated controllers report: a CB3
            estimates them from motor currents. Nothing is added to the measurements of two controllers.
        grippers_mounted: True if grippers are mounted even though the task does not use them: the safety gate measures
            distances with them.
        equipment: Grippers and what they handle; set by the task.
        tools: Tools of the left and the right arm, as `Tool` or by name; None: those of the task.
        cameras: Cameras of the cell by their names in scenes, such as "left/wrist": each takes the place of the scene's
            own of that name, or is a further one.

    Raises:
        RateError: The physics step does not divide the tick.
        SettingsError: Another value is not legal.
    """

    kind: str = "mujoco"
    left: ArmMount = field(default_factory=lambda: default_mount(0))
    right: ArmMount = field(default_factory=lambda: default_mount(1))
    servoj: ServojProfile = field(default_factory=lambda: DEFAULT_SERVOJ)
    timestep_s: float | None = None
    integrator: str | None = None
    gains: Gains | None = None
    minimum_clearance_m: float = MINIMUM_M
    perturbation: Perturbation = field(default_factory=Perturbation)
    meshes: bool = False
    speed_rad_s: float | None = None
    tcp_speed_m_s: float | None = None
    tcp_m: tuple[Vector3, Vector3] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    acceleration_rad_s2: float | None = None
    jerk_rad_s3: float | None = None
    measured_lookahead_s: float | None = None
    speed_factor: float = 1.0
    obstacles: tuple[Obstacle, ...] = ()
    uncertainty: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    file: CellSource | None = None
    wrench_noise: tuple[float, float] = (2.0, 0.2)
    grippers_mounted: bool = False
    equipment: Equipment = field(default_factory=Equipment)
    tools: tuple[Tool, Tool] | None = None
    cameras: tuple[tuple[str, Camera], ...] = ()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({changed(self)})"

    def __post_init__(self) -> None:
        kind = cell_kind(self.kind)
        for name, wanted in (("servoj", ServojProfile), ("perturbation", Perturbation), ("equipment", Equipment)):
            if not isinstance(getattr(self, name), wanted):
                raise SettingsError(
                    f"{name} of the cell must be a {wanted.__name__}, found {type(getattr(self, name)).__name__}"
                )
        self._settle_models()
        self._settle_tools()
        if self.servoj.damping < LEAST_DAMPING:
            least = (2 * LEAST_DAMPING / self.servoj.lookahead_s) ** 2
            raise SettingsError(
                f"servoj with lookahead_s={self.servoj.lookahead_s:g} and gain={self.servoj.gain:g} swings (damping "
                f"{self.servoj.damping:.2f}, allowed {LEAST_DAMPING} or more): the arms would leave the limits that "
                f"their targets keep. Choose a gain of {least:.0f} or more, or a longer lookahead"
            )
        _number("minimum_clearance_m", self.minimum_clearance_m)
        if not 0.005 <= self.minimum_clearance_m < CLEARANCE_CUTOFF_M:
            raise SettingsError(
                f"minimum_clearance_m is {self.minimum_clearance_m!r}: it must be at least 0.005 m and below "
                f"{CLEARANCE_CUTOFF_M} m, beyond which distances are not measured"
            )
        for name in ("speed_rad_s", "tcp_speed_m_s", "acceleration_rad_s2", "jerk_rad_s3"):
            value = getattr(self, name)
            if value is not None and not _number(name, value) >= LEAST_CAP:
                raise SettingsError(f"{name} of the cell is {value!r}: it must be {LEAST_CAP} or more, or None")
        lookahead_s, (low, high) = self.measured_lookahead_s, MEASURED_LOOKAHEAD_S
        if lookahead_s is not None and not low <= _number("measured_lookahead_s", lookahead_s) <= high:
            raise SettingsError(
                f"measured_lookahead_s of the cell is {lookahead_s!r}: allowed are {low} to {high}, or None"
            )
        if not 0.0 < _number("speed_factor", self.speed_factor) <= 1.0:
            raise SettingsError(f"speed_factor of the cell is {self.speed_factor!r}: it must be above 0 and at most 1")
        if kind.file is not (self.file is not None):
            needs = "needs a cell file: pass its path as `cell`" if kind.file else "has no cell file: leave it out"
            raise SettingsError(f"a cell of kind {self.kind!r} {needs}")
        checked_base_uncertainty(self.uncertainty)
        object.__setattr__(self, "tcp_m", checked_tcp(self.tcp_m))
        noise = self.wrench_noise
        if not (isinstance(noise, tuple | list) and len(noise) == 2):
            raise SettingsError(f"wrench_noise is {noise!r}: it must be two numbers (N, N·m)")
        if not all(0 <= _number("wrench_noise", each) <= 100 for each in noise):
            raise SettingsError(f"wrench_noise is {noise!r}: allowed are 0 to 100 (N, N·m)")
        object.__setattr__(self, "wrench_noise", (float(noise[0]), float(noise[1])))
        _ = self.substeps
        if self.integrator not in (None, *INTEGRATORS):
            raise UnknownNameError("integrator", str(self.integrator), INTEGRATORS)
        if self.gains is not None:
            check_gains(self.gains)
        if None not in (self.gains, self.timestep_s):
            _ = self.scene  # otherwise the task's own decide whether the integrator is stable

    def _settle_models(self) -> None:
        """Complete what is left out of mounts and servoj, and refuse controllers of another family than the arms.

        Raises:
            SettingsError: An arm's controller would be of another family than the cell's.
        """
        mounts = [self.left, self.right]
        for arm, mount in zip(ARMS, mounts, strict=True):
            if not isinstance(mount, ArmMount):
                raise SettingsError(f"{arm} of the cell must be an ArmMount, found {type(mount).__name__}")
        given = [mount for arm, mount in enumerate(mounts) if mount is not default_mount(arm)]
        servoj = self.servoj
        if servoj is DEFAULT_SERVOJ and given:
            servoj = replace(servoj, family=given[0].model.family)
        robot = given[0].robot if given else MODEL_OF_FAMILY[servoj.family]
        mounts = [default_mount(arm, robot) if m is default_mount(arm) else m for arm, m in enumerate(mounts)]
        for arm, mount in zip(ARMS, mounts, strict=True):
            if mount.model.family != servoj.family:
                raise SettingsError(
                    f"the {arm} arm is a {mount.model.title}, whose controller is of the family {mount.model.family} "
                    f"({1e3 * mount.model.tick_s:g} ms), the cell's servoj is of {servoj.family} "
                    f"({1e3 * servoj.tick_s:g} ms): both arms need one control period. Name models of one family, and "
                    "that family in servoj"
                )
        for name, value in zip((*ARMS, "servoj"), (*mounts, servoj), strict=True):
            object.__setattr__(self, name, value)

    def _settle_tools(self) -> None:
        """Put the cell's own tools in place of the default ones of its equipment.

        Raises:
            UnknownNameError: There is no tool of a name.
            SettingsError: The task needs others, or `tools` is none.
        """
        if self.tools is None:
            return
        tools, needed = tools_of(self.tools), self.equipment.tools
        if needed not in (DEFAULT_TOOLS, tools):
            names = (" and ".join(tool.name for tool in each) for each in (needed, tools))
            raise SettingsError("the task needs the tools {}, and the cell has {}: mount them".format(*names))
        object.__setattr__(self, "tools", tools)
        object.__setattr__(self, "equipment", replace(self.equipment, tools=tools))

    @property
    def robots(self) -> tuple[str, str]:
        """Models of both arms."""
        return self.left.robot, self.right.robot

    @property
    def scene(self) -> SceneSettings:
        """The scene of this cell.

        Raises:
            SettingsError: The integrator is unstable.
        """
        scene = self._scene
        lightest = float(np.min(self.perturbation.mass_scale))
        integrator = self.integrator
        if integrator is None:
            number = stability_number(scene.gains, scene.timestep_s, lightest, robots=self.robots)
            integrator = "Euler" if number <= MOST_UNSTABLE else "implicitfast"
        check_integrator(integrator, scene.gains, scene.timestep_s, lightest, robots=self.robots)
        return replace(scene, integrator=integrator)

    @property
    def _scene(self) -> SceneSettings:
        """The scene, with the integrator that is always stable."""
        given = {"timestep_s": self.timestep_s, "gains": self.gains}
        return SceneSettings(
            left=self.left,
            right=self.right,
            meshes=self.meshes,
            equipment=self.equipment,
            obstacles=self.obstacles,
            cameras=self.cameras,
            **{name: value for name, value in given.items() if value is not None},  # type: ignore[arg-type]  # two types
        )

    @property
    def measured_scene(self) -> SceneSettings:
        """The scene of the collision model, with the mounted grippers even if the task does not use them.

        Grippers that nothing uses need no force, but one that both have.
        """
        scene = self.scene
        equipment = scene.equipment
        if equipment.grippers or not self.grippers_mounted:
            return scene
        least, most = zip(*(tool.force_n for tool in equipment.tools), strict=True)
        force_n = min(max(equipment.grip_force_n, *least), *most)
        return replace(scene, equipment=replace(equipment, grippers=True, grip_force_n=force_n))

    def equipped(self, equipment: Equipment, timestep_s: float, gains: Gains) -> CellConfig:
        """Return this cell with a task's equipment, and its physics step and servo gains unless the cell sets them."""
        return replace(
            self,
            equipment=equipment,
            timestep_s=timestep_s if self.timestep_s is None else self.timestep_s,
            gains=gains if self.gains is None else self.gains,
        )

    def capped(self, limits: MotionLimits) -> MotionLimits:
        """Return a task's limits, on the task's clock, tightened to those of this cell."""
        slow = self.speed_factor

        def cap(value: float, own: float | None, power: int) -> float:
            return value if own is None else min(value, own / slow**power)

        limits = limits.of(self.robots)
        speeds: Any = [cap(each, self.speed_rad_s, 1) for each in limits.speed_rad_s]
        return replace(
            limits,
            speed_rad_s=speeds,
            tcp_speed_m_s=cap(limits.tcp_speed_m_s, self.tcp_speed_m_s, 1),
            acceleration_rad_s2=cap(limits.acceleration_rad_s2, self.acceleration_rad_s2, 2),
            jerk_rad_s3=cap(limits.jerk_rad_s3, self.jerk_rad_s3, 3),
            tcp_m=self.tcp_m,
        )

    @property
    def state_is_commanded(self) -> bool:
        """True if the state of the cell is what was commanded, and nothing is measured or simulated."""
        return cell_kind(self.kind).commanded

    @property
    def controllers(self) -> bool:
        """True if arms outside of this program move."""
        return cell_kind(self.kind).controllers

    @property
    def latency_ticks(self) -> int:
        """Default action latency in ticks: that of controllers, none without them."""
        return math.ceil(LATENCY_S / self.servoj.tick_s - 1e-9) if self.controllers else 0

    @property
    def substeps(self) -> int:
        """Physics steps per controller tick."""
        timestep_s = self._scene.timestep_s
        steps = self.servoj.tick_s / timestep_s
        whole = round(steps)
        if whole < 1 or abs(steps - whole) > 1e-9 * steps:
            tick_ms = self.servoj.tick_s * 1e3
            raise RateError(
                f"timestep_s is {timestep_s:g}: it must divide the controller's tick of {tick_ms:g} ms, such as "
                f"{', '.join(f'{tick_ms / parts / 1e3:g}' for parts in (2, 4, 8))}"
            )
        return whole

    def with_perturbation(self, **values: Any) -> CellConfig:
        """Return this cell with some values of its perturbation changed."""
        return replace(self, perturbation=self.perturbation.changed(**values))


def _number(name: str, value: object) -> float:
    """Return a setting as a float; NaN passes.

    Raises:
        SettingsError: It is no number.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise SettingsError(f"{name} of the cell is {value!r}: it must be a number")
    return float(value)
