"""SimulatedWorld of two emulated controllers: a cell of `dual_ur10`, with the scene of a task or without, in MuJoCo.

A controller by itself has `ur_emulator.world.lone_arm`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dual_ur10.assets.settings import home_q_rad
from dual_ur10.envs.core.randomization import PRESETS, apply_sample
from dual_ur10.envs.core.setup import EnvSetup, task_settings
from dual_ur10.envs.sim.physics import Physics
from dual_ur10.envs.sim.servo_reference import ReferenceMotion
from dual_ur10.envs.tasks.task import SceneRequirements
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.sim2real.cell.cell import CellState, Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import ARMS
from ur_core.mjcf.torque_control import Torques
from ur_core.tools.tool import Tool, strokes_m
from ur_core.types import Array
from ur_emulator.controller.reported_values import ArmReading
from ur_emulator.motion import JointTorques
from ur_emulator.world.plant import PlantOptions
from ur_emulator.world.world import Delay, Hand


class CellWorld:
    """Two arms on a table, or the cell of a task; see `SimulatedWorld`.

    Args:
        config: Nominal cell.
        task: Id of the environment, or a shorter name, which defines the scene and the start of its episode; None:
            nothing but the arms, which start at home.
        settings: Keywords of the task; None: none.
        options: Deviation of the plant from the nominal model.

    Attributes:
        config: The cell with its scene.
    """

    names: tuple[str, ...] = ARMS

    def __init__(
        self, config: CellConfig, task: str | None, options: PlantOptions, settings: Mapping[str, Any] | None = None
    ) -> None:
        config, start = scene_of(config, task, settings, options.seed)
        self.config = config
        self.mounts: tuple[ArmMount, ...] = (config.left, config.right)
        self.tick_s, self.substeps = config.servoj.tick_s, config.substeps
        rng = np.random.default_rng(options.seed)
        self.start_q_rad: Array = np.asarray(start.q_rad, dtype=np.float64).reshape(2, 6)
        left, right = (options.mount(mount, rng) for mount in self.mounts)
        true = dataclasses.replace(config, left=left, right=right) if options.dh_error_m else config
        self._physics = Physics(true, 1, self.substeps, 1)
        self._motion = ReferenceMotion(np.zeros((1, 3 * self.substeps + 3, 12)))
        values = config.perturbation.expanded(1)
        self.sampled: Mapping[str, Array] = {} if options.plant == "nominal" else PRESETS[options.plant].sample([rng])
        values |= apply_sample(values, self.sampled)
        self._physics.perturb(values, np.arange(1))
        self.lookahead_scale: Array = values["lookahead_scale"][0]
        step_s = config.scene.timestep_s
        latency = np.rint(values["latency_s"][0] / step_s).astype(int)
        self._hands = [Hand(), Hand()]
        self._delays = [Delay(int(steps), self.start_q_rad[arm]) for arm, steps in enumerate(latency)]
        # These views are filled at the next change of positions.
        self._torque: Array = self._physics.bind("qfrc_actuator")
        self._positions, self._orientations = self._physics.bind("xpos"), self._physics.bind("xquat")
        self._qpos: Array = self._physics.bind("qpos")
        self._mocap_m, self._mocap_quat = self._physics.bind("mocap_pos"), self._physics.bind("mocap_quat")
        self._physics.reset(start, np.arange(1))
        model = self._physics.model
        grippers = config.equipment.grippers
        names = ("gripper", "finger_1", "finger_2")
        self.gripper_kg: Sequence[float] = [
            sum(float(model.body(f"{arm}/{name}").mass[0]) for name in names) if grippers else 0.0 for arm in ARMS
        ]
        self.tools: Sequence[Tool | None] = config.equipment.tools if grippers else (None, None)
        joints = 8 if grippers else 6
        self._dofs = [arm * joints + np.arange(6) for arm in range(2)]
        self._elapsed = np.zeros(1)
        self._state: CellState = self._physics.state(self._elapsed, moved=False)
        self._held_m = np.zeros(2) if self._state.gripper_m is None else self._state.gripper_m[0].copy()

    @property
    def failed(self) -> bool:
        """See `SimulatedWorld`."""
        return bool(self._physics.failed[0])

    @property
    def has_object(self) -> bool:
        """See `SimulatedWorld`."""
        return any(each.free for each in self.config.equipment.props)

    def read(self, arm: int) -> ArmReading:
        """See `SimulatedWorld`."""
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
        """See `SimulatedWorld`."""
        motion = self._motion
        for arm, (delay, plan, torque) in enumerate(zip(self._delays, plans, torques, strict=True)):
            joints, delayed = slice(6 * arm, 6 * arm + 6), delay(plan, free=torque is not None)
            for k, rows in enumerate((motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)):
                rows[0, :, joints] = delayed[:, k]
        grippers = payload = None
        if self.config.equipment.grippers:
            # The measured width of open fingers may be slightly above the maximum.
            most = strokes_m(self.config.equipment.tools)
            wanted_m = [held if each is None else each for each, held in zip(widths_m, self._held_m, strict=True)]
            grippers = np.array([[[min(max(each, 0.0), m) for each, m in zip(wanted_m, most, strict=True)]]])
            # The arm model includes the gripper's mass.
            payload = np.array([payloads_kg]) - self.gripper_kg
        wanted = [None if each is None else Torques(each.torque_nm, 1.0 - each.coulomb_scale) for each in torques]
        self._physics.advance(motion, grippers, payload, wanted)
        self._elapsed += self.tick_s
        for hand in self._hands:
            hand.pass_tick()
        self._state = self._physics.state(self._elapsed, moved=True)

    def pose(self, body: str) -> tuple[Array, Array]:
        """See `SimulatedWorld`."""
        model = self._physics.model
        props = {each.name: each.body for each in self.config.equipment.props}
        names = [model.body(index).name for index in range(1, model.nbody)]
        if body not in names and body not in props:
            raise UnknownNameError("body", body, [*props, *names])
        index = model.body(props.get(body, body)).id
        return self._positions[0, index].copy(), self._orientations[0, index].copy()

    def joints(self, prop: str) -> dict[str, float]:
        """See `SimulatedWorld`."""
        names = [joint for each in self.config.equipment.props if each.name == prop for joint in each.joints]
        return {name: float(self._state.joints[name][0]) for name in names}

    def positions(self) -> tuple[Array, Array]:
        """See `SimulatedWorld`."""
        return self._qpos[0], np.hstack([self._mocap_m[0].reshape(-1, 3), self._mocap_quat[0].reshape(-1, 4)])

    def place(self, pose: Array, prop: str = "") -> None:
        """See `SimulatedWorld`."""
        posed = [each.name for each in self.config.equipment.props if each.posed]
        free = [each.name for each in self.config.equipment.props if each.free]
        if not posed:
            raise SettingsError("this cell has no object to place")
        if not prop and len(free) != 1:
            raise SettingsError(f"prop is missing: name one of the objects of this cell, {', '.join(posed)}")
        self._physics.place(prop or free[0], pose)

    def set_joints(self, values: Mapping[str, float]) -> None:
        """See `SimulatedWorld`."""
        self._physics.set_joints(values)

    def push(self, arm: int, wrench: Array, duration_s: float) -> None:
        """See `SimulatedWorld`."""
        self._hands[arm] = Hand(np.array(wrench, dtype=np.float64), round(duration_s / self.tick_s))

    def draw(self) -> tuple[Any, Any]:
        """See `SimulatedWorld`."""
        return self._physics.model_and_data(0)


def scene_of(
    config: CellConfig, task: str | None, settings: Mapping[str, Any] | None = None, seed: int = 0
) -> tuple[CellConfig, Start]:
    """Return the cell with the scene that is simulated, and the start of the arms and props.

    Args:
        config: Nominal cell.
        task: Id or name of the environment whose scene it is; None: nothing but the arms, at home.
        settings: Keywords of the task; None: none.
        seed: Seed of the start.

    Raises:
        UnknownNameError: There is no such environment.
        SettingsError: Or one of its kinds: the task has no such keyword, or there is no task.
    """
    if task is not None:
        return _episode(config, task, settings or {}, seed)
    if settings:
        raise SettingsError(
            f"settings name {', '.join(map(str, settings))}, and no task whose keywords these are: name it with "
            "--task, in Python with task=..., or leave them out"
        )
    return _arms_at_home(config)


def _arms_at_home(config: CellConfig) -> tuple[CellConfig, Start]:
    """Return the cell with the default scene, and both arms at home."""
    scene = SceneRequirements()
    config = config.equipped(scene.equipment, scene.timestep_s, scene.gains)
    return config, Start(home_q_rad((config.left, config.right))[None])


def _episode(config: CellConfig, task: str, settings: Mapping[str, Any], seed: int) -> tuple[CellConfig, Start]:
    """Return the cell with the scene of a task, and the start of an episode."""
    task_settings(task, settings)  # no other keyword changes what is simulated
    setup = EnvSetup.resolve(task, {**settings, "cell": config, "action_latency_ticks": 0})
    return setup.config, setup.make_task().start(np.arange(1), [np.random.default_rng(seed)])
