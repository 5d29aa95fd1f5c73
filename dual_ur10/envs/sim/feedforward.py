"""Inverse dynamics of the nominal arms: the controls with which position servos follow a wanted motion."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import numpy as np

from dual_ur10.assets.collision_model import build_collision_model
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.envs.sim.servo_reference import ReferenceMotion
from ur_core.kernel import RowLoop, Struct
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.kinematics.ur10 import ARMS
from ur_core.mjcf.gains import gains_of
from ur_core.types import Array

GRAVITY_M_S2: Final = 9.81

STEPS_PER_EVALUATION: Final = 20
"""Physics steps over which inertia and velocity terms are taken as constant, evaluated in the middle."""


@lru_cache(maxsize=32)
def _arms(settings: SceneSettings) -> dict[str, Any]:
    """Return the nominal arms as the kernel takes them: two chains of six bodies, in the scene's collision model."""
    model = build_collision_model(settings)
    quaternions = np.asarray([model.body_quat, model.body_iquat], dtype=np.float64)
    turned, axes = np.ascontiguousarray(quat_to_matrix(quaternions))
    tool = "tcp" if settings.equipment.grippers else "flange"
    return {
        "offset_m": model.body_pos.copy(),
        "turned": turned,
        "axis": np.vstack([np.zeros(3), model.jnt_axis]),
        "mass_kg": model.body_mass.copy(),
        "center_m": model.body_ipos.copy(),
        "inertia": np.ascontiguousarray(axes * model.body_inertia[:, None] @ axes.swapaxes(1, 2)),
        "armature": model.dof_armature.copy(),
        "flange_m": np.stack([model.site(f"{arm}/flange").pos for arm in ARMS]),
        "tcp_m": np.stack([model.site(f"{arm}/{tool}").pos for arm in ARMS]),
    }


class FeedForward:
    """Controls of the position servos for a wanted motion.

    `ctrl = q + (kv v + M(q) a + c(q, v)) / kp`, with the speed v at which the integrator damps: after the step
    ("implicitfast"), or before it ("Euler"), which is h a less. Gravity is absent, because the model compensates it.
    Inertia and velocity terms are those of nominal arms with the declared payload. The torques that carry and
    accelerate a point mass between the fingers are added.

    Args:
        settings: The scene.
        n: Number of cells.
        steps: Physics steps per call.
        threads: Threads to compute on.
    """

    def __init__(self, settings: SceneSettings, n: int, steps: int, threads: int) -> None:
        both = [gains_of(robot, settings.gains) for robot in settings.robots]
        kp, kv = (np.concatenate(each) for each in zip(*both, strict=True))
        self._carries = carries = settings.equipment.grippers
        self.control: Array = np.zeros((n, steps, 2, 7 if carries else 6))
        """Controls of each arm's joints and, behind them, of its gripper, if it has one."""
        self._declared_kg: Array = np.zeros((n, 2))
        self._payload_kg: Array = np.zeros((n, 2, 2))  # before and after a call
        self._motion: ReferenceMotion | None = None
        self._threads = threads
        self._fields = _arms(settings) | {
            "n": n,
            "steps": steps,
            "stride": self.control.shape[3],
            "block": STEPS_PER_EVALUATION,
            "carries": int(carries),
            "damps_before_s": settings.timestep_s if settings.integrator == "Euler" else 0.0,
            "gravity_m_s2": GRAVITY_M_S2,
            "compliance": 1.0 / kp,
            "damping": kv / kp,
            "declared_kg": self._declared_kg,
            "payload_kg": self._payload_kg,
            "control": self.control,
        }

    def declare_payload(self, mass_kg: Array) -> None:
        """Declare a mass at each flange, (n, 2), to the controller, in place of the one before."""
        self._declared_kg[:] = mass_kg

    def __call__(self, motion: ReferenceMotion, before_kg: Array | float = 0.0, after_kg: Array | float = 0.0) -> Array:
        """Return `control`, (n, steps, 2, 6 or 7), with those of the joints written anew.

        Args:
            motion: Wanted motion.
            before_kg: Declared mass in each gripper before the motion, (n, 2); without grippers it has no effect.
            after_kg: That after it, to which it rises linearly.
        """
        if motion is not self._motion:  # the reference keeps writing to the same one
            self._motion = motion
            rows = motion.rows
            struct = Struct("FeedForward", **self._fields, outputs=rows.shape[1], motion=rows)
            self._step = RowLoop("feed_forward_step", struct, len(rows), self._threads)
        if self._carries:
            self._payload_kg[:, 0], self._payload_kg[:, 1] = before_kg, after_kg
        self._step()
        return self.control
