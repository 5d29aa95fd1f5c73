"""Torque control of simulated arms: their joints receive torques instead of following a motion."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

from ur_core.types import Array, Rows

# MuJoCo's friction creeps under load. The hardest constraint that it allows creeps least: under a third of its limit,
# a joint of a UR10 moves by 0.0015 degrees per minute, and with MuJoCo's default by 7.5 degrees.
_STICKING: Final = (0.9999, 0.9999, 0.001, 0.5, 2.0)  # solimp
_STIFF_STEPS: Final = 2.0  # time constant of the constraint in physics steps, the shortest that is stable

_FIELDS: Final = ("actuator_gainprm", "actuator_biasprm", "dof_frictionloss", "dof_solimp", "dof_solref")
"""Fields of MuJoCo's model that differ between position and torque control."""


class Torques(NamedTuple):
    """Torques of one arm.

    Attributes:
        torque_nm: (6,) torques of the joints, beside those that compensate gravity.
        friction_scale: (6,) fraction of the joints' Coulomb friction that is left.
    """

    torque_nm: Array
    friction_scale: Array


class TorqueControl:
    """Switch of one arm between position servos and torques, in all cells of a batch.

    Args:
        batch: A batch of models composed by `dual_ur10.assets.scene`.
        actuators: (6,) actuators of the arm.
        dofs: (6,) degrees of freedom of the arm.
    """

    def __init__(self, batch: Any, actuators: Rows, dofs: Rows) -> None:
        self._batch, self._actuators, self._dofs = batch, actuators, dofs
        self._servo: dict[str, Array] = {}  # values of position control, while it is off

    def __call__(self, control: Array, torques: Torques | None) -> None:
        """Write the controls of the arm's joints, (n, steps, nu), if it has torques, and switch its actuators."""
        if torques is None:
            self._end()
            return
        if not self._servo:
            self._begin()
        control[..., self._actuators] = torques.torque_nm
        self._field("dof_frictionloss")[:, self._dofs] = self._servo["dof_frictionloss"] * torques.friction_scale

    def _begin(self) -> None:
        self._servo = {name: self._field(name)[:, self._columns(name)].copy() for name in _FIELDS}
        gain, bias = self._field("actuator_gainprm"), self._field("actuator_biasprm")
        gain[:, self._actuators] = 0.0
        gain[:, self._actuators, 0] = 1.0
        bias[:, self._actuators] = 0.0
        self._field("dof_solimp")[:, self._dofs] = _STICKING
        self._field("dof_solref")[:, self._dofs] = _STIFF_STEPS * self._batch.model.opt.timestep, 1.0

    def _end(self) -> None:
        for name, values in self._servo.items():
            self._field(name)[:, self._columns(name)] = values
        self._servo = {}

    def _field(self, name: str) -> Array:
        values: Array = self._batch.expand(name)
        return values

    def _columns(self, name: str) -> Rows:
        return self._actuators if name.startswith("actuator") else self._dofs
