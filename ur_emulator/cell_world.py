"""Simulated world of two emulated controllers: one cell in MuJoCo, driven by their reference motions."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from dual_ur10.assets.gripper import OPENING_M
from dual_ur10.assets.settings import home_q_rad
from dual_ur10.assets.torque_control import Torques
from dual_ur10.envs.core.randomization import PRESETS, apply_sample
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.sim.physics import Physics
from dual_ur10.envs.sim.servo_reference import Motion
from dual_ur10.envs.tasks.task import SceneRequirements
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.config.cell import CellConfig, CellState, Start
from dual_ur10.types import Array, constant
from ur_emulator.controller import ArmReading
from ur_emulator.motion import JointTorques

PLANTS: Final = ("nominal", "mild", "wide")
"""Deviation of the plant from its nominal model: none, or the randomization of that name."""

NO_WRENCH: Final = constant(np.zeros(6))

_MAX_DH_ERROR_M: Final = 0.02


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlantOptions:
    """Simulated plant.

    Attributes:
        plant: "nominal" for the nominal model. "mild" or "wide" for a sample from the randomization of that name:
            masses, friction, lookahead, latency, base poses, object and grip.
        seed: Seed of the sample, and of the start of a task's episode.
        dh_error_m: Largest random error of the lengths in the arms' kinematics, m.
    """

    plant: str = "mild"
    seed: int = 0
    dh_error_m: float = 0.0

    def __post_init__(self) -> None:
        if self.plant not in PLANTS:
            raise UnknownNameError("plant", self.plant, PLANTS)
        if not isinstance(self.seed, int) or self.seed < 0:
            raise SettingsError(f"seed is {self.seed!r}: it must be a whole number, 0 or above")
        if not 0.0 <= self.dh_error_m <= _MAX_DH_ERROR_M:
            raise SettingsError(f"dh_error_m is {self.dh_error_m!r}: allowed are 0 to {_MAX_DH_ERROR_M:g} m")


class CellWorld:
    """Two arms on a table, or the cell of a task, advanced by one control period at a time.

    Args:
        config: Nominal cell.
        task: Id of the environment, or a shorter name, which defines the scene and the start of its episode; None:
            nothing but the arms, which start at home.
        options: Deviation of the plant from the nominal model.

    Attributes:
        config: The cell with its scene.
        substeps: Physics steps per control period.
        start_q_rad: (2, 6) initial joint positions.
        lookahead_scale: (2,) ratio of each controller's true lookahead to the commanded one.
        gripper_kg: Mass of one gripper; 0 without grippers.
        sampled: Sampled parameters of the plant, by name.
    """

    def __init__(self, config: CellConfig, task: str | None, options: PlantOptions) -> None:
        config, start = _arms_at_home(config) if task is None else _episode(config, task, options.seed)
        self.config = config
        self.substeps = config.substeps
        rng = np.random.default_rng(options.seed)
        self.start_q_rad: Array = np.asarray(start.q_rad, dtype=np.float64).reshape(2, 6)
        true = _with_dh_errors(config, options.dh_error_m, rng)
        self._physics = Physics(true, 1, self.substeps, 1)
        self._motion = Motion(np.zeros((1, 3 * self.substeps + 3, 12)))
        values = config.perturbation.expanded(1)
        self.sampled: Mapping[str, Array] = {} if options.plant == "nominal" else PRESETS[options.plant].sample([rng])
        values |= apply_sample(values, self.sampled)
        self._physics.perturb(values, np.arange(1))
        self.lookahead_scale: Array = values["lookahead_scale"][0]
        step_s = config.scene.timestep_s
        latency = np.rint(values["latency_s"][0] / step_s).astype(int)
        self._hands = [_Hand(), _Hand()]
        self._delays = [_Delay(int(steps), self.start_q_rad[arm]) for arm, steps in enumerate(latency)]
        # These views are filled at the next change of positions.
        self._torque: Array = self._physics.bind("qfrc_actuator")
        self._positions, self._orientations = self._physics.bind("xpos"), self._physics.bind("xquat")
        self._physics.reset(start, np.arange(1))
        model = self._physics.model
        grippers = config.equipment.grippers
        names = ("gripper", "finger_1", "finger_2")
        self.gripper_kg = sum(float(model.body(f"left/{name}").mass[0]) for name in names) if grippers else 0.0
        joints = 8 if grippers else 6
        self._dofs = [arm * joints + np.arange(6) for arm in range(2)]
        self._elapsed = np.zeros(1)
        self._state: CellState = self._physics.state(self._elapsed, moved=False)

    @property
    def failed(self) -> bool:
        """True after the simulation has diverged. The arms stay at their last valid state."""
        return bool(self._physics.failed[0])

    def read(self, arm: int) -> ArmReading:
        """Measure one arm. A hand that pushes it adds to the wrench on its flange."""
        state = self._state
        wrench = np.zeros(6) if state.wrench is None else state.wrench[0, arm]
        return ArmReading(
            state.q_rad[0, arm].copy(),
            state.qd_rad_s[0, arm].copy(),
            self._torque[0, self._dofs[arm]].copy(),
            wrench + self._hands[arm].wrench,
            None if state.gripper_m is None else float(state.gripper_m[0, arm]),
        )

    def advance(
        self,
        plans: Sequence[Array],
        widths_m: Sequence[float | None],
        payloads_kg: Sequence[float],
        torques: Sequence[JointTorques | None] = (None, None),
    ) -> None:
        """Advance by one control period.

        Args:
            plans: Per arm (substeps, 3, 6): position before, speed after and acceleration in every physics step.
            widths_m: Commanded gripper width of each arm.
            payloads_kg: Payload mass as set on each controller.
            torques: Torques of each arm, in place of its plan; None in position control. The controllers know the
                friction of their joints.
        """
        motion = self._motion
        for arm, (delay, plan, torque) in enumerate(zip(self._delays, plans, torques, strict=True)):
            joints, delayed = slice(6 * arm, 6 * arm + 6), delay(plan, free=torque is not None)
            for k, rows in enumerate((motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)):
                rows[0, :, joints] = delayed[:, k]
        grippers = payload = None
        if self.gripper_kg:
            # The measured width of open fingers may be slightly above the maximum.
            grippers = np.array([[[min(max(each or 0.0, 0.0), OPENING_M) for each in widths_m]]])
            # The arm model includes the gripper's mass.
            payload = np.array([payloads_kg]) - self.gripper_kg
        wanted = [None if each is None else Torques(each.torque_nm, 1.0 - each.coulomb_scale) for each in torques]
        self._physics.advance(motion, grippers, payload, wanted)
        self._elapsed += self.config.servoj.tick_s
        for hand in self._hands:
            hand.pass_tick()
        self._state = self._physics.state(self._elapsed, moved=True)

    def pose(self, body: str) -> tuple[Array, Array]:
        """Return position (3,) and orientation (4,), (w, x, y, z), of a body in the cell frame.

        Raises:
            UnknownNameError: There is no such body.
        """
        model = self._physics.model
        names = [model.body(index).name for index in range(1, model.nbody)]
        if body not in names:
            raise UnknownNameError("body", body, names)
        index = model.body(body).id
        return self._positions[0, index].copy(), self._orientations[0, index].copy()

    def place(self, pose: Array) -> None:
        """Place the handled object at a pose, (7,) position and (w, x, y, z), at rest.

        Raises:
            SettingsError: There is none.
        """
        self._physics.place(pose)

    def push(self, arm: int, wrench: Array, duration_s: float) -> None:
        """Push the flange of an arm by hand, in place of an earlier push.

        The arms follow their reference motions, whatever pushes them: only a compliant one, as in freedrive, yields.

        Args:
            arm: Index of the arm.
            wrench: (6,) force and torque on the flange, N and N·m, along the axes of the arm's `base`.
            duration_s: Duration, rounded to control periods.
        """
        self._hands[arm] = _Hand(np.array(wrench, dtype=np.float64), round(duration_s / self.config.servoj.tick_s))

    def draw(self) -> tuple[Any, Any]:
        """Return MuJoCo's model and data of the present state: the same objects at every call."""
        return self._physics.model_and_data(0)


class _Delay:
    """Motion that arrives late by whole physics steps.

    Torques act at once. A motion that follows them begins where they brought the arm, so it is not delayed either until
    the arm stops.

    Args:
        steps: How late.
        q_rad: (6,) where the arm stands until then.
    """

    def __init__(self, steps: int, q_rad: Array) -> None:
        self._waiting = np.zeros((steps, 3, 6))
        self._waiting[:, 0] = q_rad
        self._delays = True

    def __call__(self, plan: Array, *, free: bool = False) -> Array:
        steps = len(self._waiting)
        if free or not (self._delays or not plan[:, 1].any()):
            self._delays = False
            return plan
        if not self._delays:
            self._delays = True
            self._waiting[:] = 0.0
            self._waiting[:, 0] = plan[0, 0]
        if not steps:
            return plan
        queue = np.concatenate([self._waiting, plan])
        self._waiting = queue[len(plan) :]
        return queue[: len(plan)]


class _Hand:
    """Push by a hand.

    Args:
        wrench: (6,) wrench on the flange.
        ticks: Control periods that it lasts.
    """

    def __init__(self, wrench: Array = NO_WRENCH, ticks: int = 0) -> None:
        self._ticks = ticks
        self.wrench: Array = wrench if ticks > 0 else NO_WRENCH

    def pass_tick(self) -> None:
        """Let a control period pass."""
        self._ticks -= 1
        if self._ticks <= 0:
            self.wrench = NO_WRENCH


def _arms_at_home(config: CellConfig) -> tuple[CellConfig, Start]:
    """Return the cell with the default scene, and both arms at home."""
    scene = SceneRequirements()
    config = config.equipped(scene.equipment, scene.timestep_s, scene.gains)
    return config, Start(home_q_rad((config.left, config.right))[None])


def _episode(config: CellConfig, task: str, seed: int) -> tuple[CellConfig, Start]:
    """Return the cell with the scene of a task, and the start of an episode."""
    setup = EnvSetup.resolve(task, {"cell": config, "action_latency_ticks": 0})
    return setup.config, setup.make_task().start(np.arange(1), [np.random.default_rng(seed)])


def _with_dh_errors(config: CellConfig, most_m: float, rng: np.random.Generator) -> CellConfig:
    """Return the cell with random errors of its kinematics."""
    if not most_m:
        return config
    mounts = {}
    for arm in ARMS:
        mount = getattr(config, arm)
        a_m = np.asarray(mount.dh.a_m) + rng.uniform(-most_m, most_m, 6) * (np.asarray(mount.dh.a_m) != 0.0)
        d_m = np.asarray(mount.dh.d_m) + rng.uniform(-most_m, most_m, 6) * (np.asarray(mount.dh.d_m) != 0.0)
        dh = dataclasses.replace(mount.dh, a_m=tuple(a_m), d_m=tuple(d_m))
        mounts[arm] = dataclasses.replace(mount, dh=dh)
    return dataclasses.replace(config, **mounts)
