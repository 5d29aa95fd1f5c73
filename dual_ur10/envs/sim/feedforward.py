"""Feed-forward of the joint servos: torque of the wanted motion, by the controller's model of the arm."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.collision_model import build_collision_model
from dual_ur10.assets.settings import GAINS, SceneSettings
from dual_ur10.envs.sim.plant import write_masses
from dual_ur10.kinematics.rotations import cross
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.types import Array

GRAVITY_M_S2 = 9.81

STEPS_PER_EVALUATION = 20
"""Physics steps over which inertia and velocity terms are taken as constant, evaluated in the middle."""


class FeedForward:
    """Controls of the position servos for a wanted motion.

    `ctrl = q + (kv v + M(q) a + c(q, v)) / kp`, with the speed v at which the integrator damps: after the step
    ("implicitfast"), or before it ("Euler"), which is h a less. Gravity is absent, because the model compensates it.
    Inertia and velocity terms come from a batch of nominal arms with the declared payload.

    Args:
        settings: The scene.
        n: Number of cells.
        threads: Threads to compute on.
    """

    def __init__(self, settings: SceneSettings, n: int, threads: int) -> None:
        import mujoco
        from mujoco.batch import Batch

        model = build_collision_model(settings)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        self._batch: Any = Batch(model, n, threads)
        self._stage = int(mujoco.mjtStage.mjSTAGE_VEL)
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._inertia, self._bias = self._batch.bind("M"), self._batch.bind("qfrc_bias")
        self._entries = _dense_entries(model)
        kp, kv = (np.tile(gains, 2) for gains in GAINS[settings.gains])
        self._compliance, self._damping = 1.0 / kp, kv / kp
        # Accelerations multiply from the left, so torques are columns. The arms' inertias do not couple.
        self._weight_of_entries = np.kron(np.eye(2), np.ones((6, 6))) * self._compliance
        damps_before_s = settings.timestep_s if settings.integrator == "Euler" else 0.0
        self._undamped = np.diag(damps_before_s * self._damping)
        self.n = n
        self._declared_kg: Array = np.zeros((n, 2))
        self._payload = PayloadTorque(self._batch, kp) if settings.equipment.grippers else None

    def declare_payload(self, mass_kg: Array) -> None:
        """Declare a mass at each flange, (n, 2), to the controller, in place of the one before."""
        if (mass_kg != self._declared_kg).any():
            write_masses(self._batch, np.ones_like(mass_kg), mass_kg)
            self._declared_kg = mass_kg.copy()

    def __call__(self, q: Array, v: Array, a: Array, payload_kg: Array | None = None) -> Array:
        """Return the controls of every physics step, (n, steps, 12).

        Args:
            q: (n, steps, 12) wanted positions before each step.
            v: (n, steps, 12) wanted speeds after it.
            a: (n, steps, 12) wanted accelerations in it.
            payload_kg: (n, steps, 2) declared mass in each gripper, or None.
        """
        control: Array = v * self._damping
        control += q
        for start in range(0, q.shape[1], STEPS_PER_EVALUATION):
            part = slice(start, start + STEPS_PER_EVALUATION)
            control[:, part] += self._shift(q[:, part], v[:, part], a[:, part])
            if payload_kg is not None and self._payload is not None:
                control[:, part] += self._payload(a[:, part], payload_kg[:, part])
        return control

    def _shift(self, q: Array, v: Array, a: Array) -> Array:
        """Return the lead of the controls, (n, steps, 12), with which the servos exert the torque of this motion."""
        middle = q.shape[1] // 2
        self._qpos[:], self._qvel[:] = q[:, middle], v[:, middle]
        self._batch.forward(stage=self._stage)
        per_acceleration = self._inertia.take(self._entries, axis=1)
        per_acceleration *= self._weight_of_entries
        per_acceleration -= self._undamped
        shift: Array = a @ per_acceleration
        shift += (self._bias * self._compliance)[:, None]
        return shift


class PayloadTorque:
    """Lead of the controls with which the servos carry and accelerate a point mass between the fingers.

    Args:
        batch: Batch of nominal arms, evaluated at the configuration.
        kp: (12,) stiffness of the servos.
    """

    def __init__(self, batch: Any, kp: Array) -> None:
        model = batch.model
        self._points = [model.site(f"{arm}/tcp").id for arm in ARMS]
        self._point, self._anchor, self._axis = (batch.bind(name) for name in ("site_xpos", "xanchor", "xaxis"))
        self._compliance = (1.0 / kp).reshape(2, 1, 6)

    def __call__(self, a: Array, payload_kg: Array) -> Array:
        """Return the lead, (n, steps, 12), for accelerations, (n, steps, 12), and masses, (n, steps, 2)."""
        n, steps = a.shape[:2]
        away = self._point[:, self._points][:, :, None] - self._anchor[:, :12].reshape(n, 2, 6, 3)
        jacobian = cross(self._axis[:, :12].reshape(n, 2, 6, 3), away)
        accelerations = a.reshape(n, steps, 2, 6).swapaxes(1, 2) @ (jacobian @ jacobian.swapaxes(2, 3))
        torque = accelerations + GRAVITY_M_S2 * jacobian[:, :, None, :, 2]
        torque *= payload_kg.swapaxes(1, 2)[..., None]
        torque *= self._compliance
        result: Array = torque.swapaxes(1, 2).reshape(n, steps, 12)
        return result


def _dense_entries(model: Any) -> NDArray[np.intp]:
    """Return the indices, (12, 12), into MuJoCo's sparse inertia matrix; 0 where the dense one has no entry."""
    entries = np.zeros((12, 12), dtype=np.intp)
    for i in range(12):
        start = int(model.M_rowadr[i])
        for k in range(int(model.M_rownnz[i])):
            j = int(model.M_colind[start + k])
            entries[i, j] = entries[j, i] = start + k
    return entries
