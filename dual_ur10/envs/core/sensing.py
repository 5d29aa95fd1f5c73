"""Measured state of a cell: noise, delay and base pose errors on top of the true state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dual_ur10.envs.core.randomization import Randomization
from dual_ur10.sim2real.cell.cell import CellState
from dual_ur10.sim2real.cell.cell_config import CellConfig
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import quat_from_rotvec, quat_multiply
from ur_core.types import Array, Rows

_AGING = ("q_rad", "qd_rad_s", "flange_base_m", "flange_m", "gripper_m", "wrench")
_TURNING = ("flange_base_quat", "flange_quat")


class Sensing:
    """Sensor model from the true state of n cells to the measured one.

    Args:
        config: The cell.
        randomization: Noise, in addition to that of the cell's wrench.
        period_s: Time between two observations.
        n: Number of cells.

    Attributes:
        tracked: Names of the props whose poses are measured.
        is_exact: True if the measured state is the true one.
        keeps_poses: True if poses and gripper widths are measured without error; joints and wrenches may have noise.
    """

    def __init__(self, config: CellConfig, randomization: Randomization, period_s: float, n: int) -> None:
        self._frames = Frames((config.left, config.right))
        self._period_s, self.n = period_s, n
        joint, speed = randomization.joint_noise_rad, randomization.joint_speed_noise_rad_s
        # Values of two controllers are measured already: no noise is added.
        simulated = not config.controllers
        force, torque = config.wrench_noise if simulated and config.equipment.grippers else (0.0, 0.0)
        self._sigma = np.repeat([joint, speed, force, torque], [12, 12, 6, 6])
        self._noisy = bool(self._sigma.any())
        self._noisy_joints = bool(self._sigma[:24].any())
        self._offset = bool(randomization.object_noise_m or randomization.object_noise_rad)
        plant = config.perturbation.expanded(n)
        moved = plant["base_shift_m"].any() or plant["base_turn_rad"].any()
        self._moved = bool(moved or randomization.base_shift_m or randomization.base_turn_rad)
        self._late = bool(randomization.observation_delay_s)
        self._all = np.arange(n)
        self.is_exact = not (self._noisy or self._offset or self._moved or self._late)
        self.keeps_poses = not (self._offset or self._moved or self._late)
        self._rngs = [np.random.default_rng(0) for _ in range(n)]
        self.tracked = tracked(config)
        self._noises = [each.noise for each in config.equipment.props if each.name in self.tracked]
        self._shift: Array = np.zeros((n, len(self.tracked), 3))
        self._turn: Array = np.tile([1.0, 0.0, 0.0, 0.0], (n, len(self.tracked), 1))
        self._age: Array = np.zeros(n)
        self._noise: Array = np.zeros((n, 36))
        self._before: CellState | None = None

    def reset(self, state: CellState, rows: Rows, seeds: Sequence[int], sampled: Mapping[str, Array]) -> None:
        """Begin episodes in `rows`.

        Args:
            state: The true state.
            rows: Cells that begin.
            seeds: Seed of the noise, one per cell that begins.
            sampled: Result of `Randomization.sample`, (len(rows), ...) each.
        """
        for row, seed in zip(rows.tolist(), seeds, strict=True):
            self._rngs[row] = np.random.default_rng(seed)
        if sampled:
            for k, noise in enumerate(self._noises):
                self._shift[rows, k] = noise * sampled["object_offset_m"][:, k]
                self._turn[rows, k] = quat_from_rotvec(noise * sampled["object_offset_rad"][:, k])
            self._age[rows] = np.minimum(sampled["observation_delay_s"] / self._period_s, 1.0)
        if self._late:
            self._before = _copy(state)  # rows that continue have not moved since their last observation
        if self._noisy:
            self._sample_noise(rows)

    def begun(self, state: CellState) -> CellState:
        """Return the measured state after `reset`; rows that continue have no meaning in it."""
        return self._measured(state, _copy(state) if self._late else None)

    def __call__(self, state: CellState) -> CellState:
        """Return the measured state after a step. Call it once per step: it samples noise and keeps the state."""
        if self.is_exact:
            return state
        if self._noisy:
            self._sample_noise(self._all)
        before, self._before = self._before, _copy(state) if self._late else None
        return self._measured(state, before)

    def _sample_noise(self, rows: Rows) -> None:
        for row in rows.tolist():
            self._rngs[row].standard_normal(out=self._noise[row])

    def _measured(self, state: CellState, before: CellState | None) -> CellState:
        measured = state if before is None else self._aged(state, before)
        if self._moved:
            measured = measured._replace(flange_m=self._frames.position_to_cell(measured.flange_base_m))
            if measured.flange_quat is not None:
                measured = measured._replace(flange_quat=self._frames.quat_to_cell(measured.flange_base_quat))
        if self._offset and self.tracked:
            objects = dict(measured.objects)
            for k, name in enumerate(self.tracked):
                position_m, quat = objects[name]
                turned = quat_multiply(self._turn[:, k, None], quat[:, None])[:, 0]
                objects[name] = Poses(position_m + self._shift[:, k], turned)
            measured = measured._replace(objects=objects)
        return self._with_noise(measured) if self._noisy else measured

    def _aged(self, state: CellState, before: CellState) -> CellState:
        changed: dict[str, Any] = {}
        for name in (*_AGING, *_TURNING):
            old, new = getattr(before, name), getattr(state, name)
            if old is None or new is None:
                continue
            age = self._age.reshape(-1, *[1] * (new.ndim - 1))
            changed[name] = _turned(new, old, age) if name in _TURNING else new + age * (old - new)
        age = self._age[:, None]
        objects = dict(state.objects)
        for name in self.tracked:
            old, new = before.objects[name], state.objects[name]
            position_m = new.position_m + age * (old.position_m - new.position_m)
            objects[name] = Poses(position_m, _turned(new.quat, old.quat, age))
        joints = {name: new + self._age * (before.joints[name] - new) for name, new in state.joints.items()}
        return state._replace(**changed, objects=objects, joints=joints)

    def _with_noise(self, state: CellState) -> CellState:
        noise = self._noise * self._sigma
        if self._noisy_joints:
            q_rad, qd_rad_s = noise[:, :24].reshape(-1, 2, 2, 6).swapaxes(0, 1)
            state = state._replace(q_rad=state.q_rad + q_rad, qd_rad_s=state.qd_rad_s + qd_rad_s)
        if state.wrench is None:
            return state
        # The noise is that of both forces, then of both torques.
        wrench = noise[:, 24:].reshape(-1, 2, 2, 3).swapaxes(1, 2).reshape(-1, 2, 6)
        wrench += state.wrench
        return state._replace(wrench=wrench)


def tracked(config: CellConfig) -> tuple[str, ...]:
    """Return the names of the props whose poses are measured."""
    return tuple(each.name for each in config.equipment.props if each.posed and each.tracked)


def _turned(new: Array, old: Array, age: Array) -> Array:
    """Return orientations between new and old ones."""
    old = old * np.copysign(1.0, np.add.reduce(old * new, axis=-1, keepdims=True))
    mixed = new + age * (old - new)
    result: Array = mixed / np.sqrt(np.add.reduce(mixed * mixed, axis=-1, keepdims=True))
    return result


def _copy(state: CellState) -> CellState:
    values: Any = (each.copy() if isinstance(each, np.ndarray) else each for each in state)
    return CellState(*values)._replace(
        objects={name: Poses(*(each.copy() for each in pose)) for name, pose in state.objects.items()},
        joints={name: each.copy() for name, each in state.joints.items()},
    )
