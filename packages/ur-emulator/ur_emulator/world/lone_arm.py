"""SimulatedWorld of one emulated controller: its arm by itself in MuJoCo, at home, without a table or anything else."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Final

import mujoco
import numpy as np

from ur_core.errors import SettingsError, UnknownNameError
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.home import home_of
from ur_core.kinematics.ur10 import ARMS, LINKS, TICK_S
from ur_core.mjcf.arm import arm_spec, remove_visuals
from ur_core.mjcf.gains import STIFF, gains_of
from ur_core.mjcf.torque_control import TorqueControl, Torques
from ur_core.tools.tool import Tool
from ur_core.types import Array
from ur_emulator.controller.reported_values import ArmReading
from ur_emulator.motion import JointTorques
from ur_emulator.world.plant import PlantOptions
from ur_emulator.world.world import Delay, Hand

STEP_S: Final = 0.002
"""Physics step: a control period of the e-Series, a quarter of one of a CB3."""

_FRICTION_NM: Final = (5.0, 5.0, 3.0, 1.0, 1.0, 1.0)
_SCALE_DIGITS: Final = 3  # of the lookahead

_STATE: Final = mujoco.mjtState.mjSTATE_INTEGRATION
_OFF: Final = mujoco.mjtDisableBit
_IDEAL: Final = int(_OFF.mjDSBL_GRAVITY | _OFF.mjDSBL_CONTACT | _OFF.mjDSBL_CONSTRAINT)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Deviations:
    """Largest deviations of a plant from the nominal arm.

    Attributes:
        mass: ± fraction of the links' masses and inertias.
        joint_friction: Fraction of 5, 5, 3, 1, 1 and 1 N·m of Coulomb friction.
        lookahead: ± fraction of the lookahead time of `servoj`.
        latency_s: Delay of the motion.
    """

    mass: float = 0.0
    joint_friction: float = 0.0
    lookahead: float = 0.0
    latency_s: float = 0.0

    def sample(self, rng: np.random.Generator) -> dict[str, Array]:
        """Sample a plant."""
        return {
            "mass_scale": 1.0 + self.mass * rng.uniform(-1.0, 1.0, 1),
            "friction_nm": self.joint_friction * rng.uniform(0.0, 1.0, 6) * np.array(_FRICTION_NM),
            "lookahead_scale": np.round(1.0 + self.lookahead * rng.uniform(-1.0, 1.0, 1), _SCALE_DIGITS),
            "latency_s": self.latency_s * rng.uniform(0.0, 1.0, 1),
        }


DEVIATIONS: Final = {
    "nominal": Deviations(),
    "mild": Deviations(mass=0.03, joint_friction=0.5, lookahead=0.03, latency_s=0.005),
    "wide": Deviations(mass=0.1, joint_friction=1.0, lookahead=0.1, latency_s=0.02),
}
"""Plants by name: as far as they concern one arm, the randomizations of the same names in `dual_ur10`."""


class LoneArm:
    """One arm, whose base is the origin; see `SimulatedWorld`.

    Its servos follow the reference motion by the inverse dynamics of the nominal arm: with a nominal plant exactly.

    Args:
        robot: Model of the arm, a name in `ur_core.kinematics.robots.ROBOTS`.
        options: Deviation of the plant from the nominal model.

    Raises:
        UnknownNameError: There is no such model.
    """

    gripper_kg: Sequence[float] = (0.0,)
    tools: Sequence[Tool | None] = (None,)
    has_object = False

    def __init__(self, robot: str, options: PlantOptions) -> None:
        rng = np.random.default_rng(options.seed)
        nominal = ArmMount((0.0, 0.0, 0.0), robot=robot)
        self.names: tuple[str, ...] = (robot,)
        self.mounts: tuple[ArmMount, ...] = (nominal,)
        self.tick_s = TICK_S[nominal.model.family]
        self.substeps = round(self.tick_s / STEP_S)
        self.start_q_rad: Array = np.array([home_of(robot)])
        sampled = DEVIATIONS[options.plant].sample(rng)
        self.sampled: Mapping[str, Array] = {} if options.plant == "nominal" else sampled
        self.lookahead_scale: Array = sampled["lookahead_scale"]
        self._true = options.mount(nominal, rng)
        self._inverse = _model_of(nominal)
        self._inverse.opt.disableflags |= _IDEAL
        self._wanted = mujoco.MjData(self._inverse)
        self._kp, self._kv = np.array(gains_of(robot, STIFF))
        self._model = _model_of(self._true)
        links = [self._model.body(f"{ARMS[0]}/{link}").id for link in LINKS]
        self._model.body_mass[links] *= sampled["mass_scale"]
        self._model.body_inertia[links] *= sampled["mass_scale"]
        self._model.body_gravcomp[links] = 1.0 / sampled["mass_scale"]  # by a controller with the nominal model
        self._model.dof_frictionloss[:] = sampled["friction_nm"]
        self._data = mujoco.MjData(self._model)
        mujoco.mj_setConst(self._model, self._data)
        joints = np.arange(6)
        self._torque = TorqueControl(_Fields(self._model), joints, joints)
        self._data.qpos[:] = self.start_q_rad[0]
        self._data.ctrl[:] = self.start_q_rad[0]
        mujoco.mj_forward(self._model, self._data)
        self._good: Array = np.zeros(mujoco.mj_stateSize(self._model, _STATE))
        mujoco.mj_getState(self._model, self._data, self._good, _STATE)
        self.failed = False
        self._hand = Hand()
        self._delay = Delay(round(float(sampled["latency_s"][0]) / STEP_S), self.start_q_rad[0])
        self._rendered: tuple[Any, Any] | None = None

    def read(self, arm: int) -> ArmReading:
        """See `SimulatedWorld`."""
        data = self._data
        return ArmReading(
            data.qpos.copy(), data.qvel.copy(), data.qfrc_actuator.copy(), np.zeros(6) + self._hand.wrench, None
        )

    def advance(
        self,
        plans: Sequence[Array],
        widths_m: Sequence[float | None],
        payloads_kg: Sequence[float],
        torques: Sequence[JointTorques | None],
    ) -> None:
        """See `SimulatedWorld`. A payload that is set has no effect: nothing is attached to the flange."""
        (plan,), (torque,) = plans, torques
        control = self._control(self._delay(plan, free=torque is not None))
        self._torque(control, None if torque is None else Torques(torque.torque_nm, 1.0 - torque.coulomb_scale))
        self._step(control[0])
        self._hand.pass_tick()

    def _control(self, plan: Array) -> Array:
        """Return the controls of the servos, (1, substeps, 6), with which a nominal arm follows a motion exactly."""
        model, data = self._inverse, self._wanted
        control = np.empty((1, len(plan), 6))
        for row, (q, qd, qdd) in zip(control[0], plan, strict=True):
            # The integrator damps at the speed after the step; velocity terms are those of the speed before it.
            data.qpos[:], data.qvel[:], data.qacc[:] = q, qd - STEP_S * qdd, qdd
            mujoco.mj_inverse(model, data)
            row[:] = q + (self._kv * qd + data.qfrc_inverse) / self._kp
        return control

    def _step(self, control: Array) -> None:
        model, data = self._model, self._data
        if not self.failed:
            for row in control:
                data.ctrl[:] = row
                mujoco.mj_step(model, data)
            self.failed = bool(data.warning.number.any())
        if self.failed:
            mujoco.mj_setState(model, data, self._good, _STATE)
        else:
            mujoco.mj_getState(model, data, self._good, _STATE)

    def pose(self, body: str) -> tuple[Array, Array]:
        """See `SimulatedWorld`. Bodies are those of the arm, such as `wrist_3_link`."""
        model, data, prefix = self._model, self._data, f"{ARMS[0]}/"
        names = [model.body(index).name.removeprefix(prefix) for index in range(2, model.nbody)]
        if body not in names:
            raise UnknownNameError("body", body, names)
        mujoco.mj_kinematics(model, data)
        index = model.body(f"{prefix}{body}").id
        return data.xpos[index].copy(), data.xquat[index].copy()

    def joints(self, prop: str) -> dict[str, float]:
        """See `SimulatedWorld`."""
        return {}

    def positions(self) -> tuple[Array, Array]:
        """See `SimulatedWorld`."""
        return self._data.qpos, np.zeros((0, 7))

    def place(self, pose: Array, prop: str = "") -> None:
        """See `SimulatedWorld`."""
        raise SettingsError("a controller by itself has no object to place: emulate a cell with the scene of a task")

    def set_joints(self, values: Mapping[str, float]) -> None:
        """See `SimulatedWorld`."""
        for name in values:
            raise UnknownNameError("joint of a prop", name, ())

    def push(self, arm: int, wrench: Array, duration_s: float) -> None:
        """See `SimulatedWorld`."""
        self._hand = Hand(np.array(wrench, dtype=np.float64), round(duration_s / self.tick_s))

    def draw(self) -> tuple[Any, Any]:
        """See `SimulatedWorld`."""
        if self._rendered is None:
            model = _model_of(self._true, visuals=True)
            self._rendered = model, mujoco.MjData(model)
        model, data = self._rendered
        data.qpos[:] = self._data.qpos
        mujoco.mj_forward(model, data)
        return self._rendered


class _Fields:
    """Fields of one model as those of a batch of one."""

    def __init__(self, model: Any) -> None:
        self.model = model

    def expand(self, name: str) -> Array:
        """Return a view, (1, ...), of a field."""
        field: Array = getattr(self.model, name)
        return field[None]


def _model_of(mount: ArmMount, *, visuals: bool = False) -> Any:
    """Return the model of one arm with its base at the origin, with its surroundings if it is drawn."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # A diverged simulation must be seen by the caller, not silently start again from t = 0.
    spec.option.disableflags |= _OFF.mjDSBL_AUTORESET
    arm = arm_spec(mount.dh, STIFF)
    if visuals:
        _surround(spec)
    else:
        remove_visuals(arm)
    base = spec.worldbody.add_body(name=f"{ARMS[0]}/", quat=mount.quat)
    spec.attach(arm, prefix=f"{ARMS[0]}/", frame=base.add_frame())
    return spec.compile()


def _surround(spec: Any) -> None:
    """Add lights, a sky and a floor to a model that is drawn."""
    for x in (-2.0, 2.0):
        spec.worldbody.add_light(pos=(x, -2.0, 4.0), dir=(-x, 2.0, -4.0), castshadow=x > 0)
    gradient, sky = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, mujoco.mjtTexture.mjTEXTURE_SKYBOX
    spec.add_texture(
        name="sky", type=sky, builtin=gradient, rgb1=(0.93, 0.95, 0.97), rgb2=(0.62, 0.69, 0.76), width=64, height=384
    )
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(
        name="floor", type=plane, size=(3.0, 3.0, 0.1), rgba=(0.4, 0.42, 0.45, 1.0), contype=0, conaffinity=0
    )
