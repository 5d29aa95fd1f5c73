"""Measured state of a cell: noise, delay and base pose errors on top of the true state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dual_ur10.envs.core.randomization import Randomization
from dual_ur10.kinematics.frames import Frames
from dual_ur10.kinematics.rotations import quat_from_rotvec, quat_multiply
from dual_ur10.sim2real.config.cell import CellConfig, CellState
from dual_ur10.types import Array, Rows

_AGING = ("q_rad", "qd_rad_s", "flange_base_m", "flange_m", "gripper_m", "wrench", "object_m")
_TURNING = ("flange_base_quat", "flange_quat", "object_quat")


class Sensing:
    """Sensor model from the true state of n cells to the measured one.

    Args:
        config: The cell.
        randomization: Noise, in addition to that of the cell's wrench.
        period_s: Time between two observations.
        n: Number of cells.

    Attributes:
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
        self._shift: Array = np.zeros((n, 3))
        self._turn: Array = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
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
            self._shift[rows] = sampled["object_offset_m"]
            self._turn[rows] = quat_from_rotvec(sampled["object_offset_rad"])
            self._age[rows] = np.minimum(sampled["observation_delay_s"] / self._period_s, 1.0)
        if self._late:
            fresh = _copy(state)
            if self._before is not None:
                for old, new in zip(self._before, fresh, strict=True):
                    if old is not None and new is not None:
                        old[rows] = new[rows]
            else:
                self._before = fresh
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
        if self._offset and measured.object_m is not None and measured.object_quat is not None:
            turned = quat_multiply(self._turn[:, None], measured.object_quat[:, None])[:, 0]
            measured = measured._replace(object_m=measured.object_m + self._shift, object_quat=turned)
        return self._with_noise(measured) if self._noisy else measured

    def _aged(self, state: CellState, before: CellState) -> CellState:
        changed = {}
        for name in (*_AGING, *_TURNING):
            old, new = getattr(before, name), getattr(state, name)
            if old is None or new is None:
                continue
            age = self._age.reshape(-1, *[1] * (new.ndim - 1))
            if name in _TURNING:
                old = old * np.copysign(1.0, np.add.reduce(old * new, axis=-1, keepdims=True))
                mixed = new + age * (old - new)
                changed[name] = mixed / np.sqrt(np.add.reduce(mixed * mixed, axis=-1, keepdims=True))
            else:
                changed[name] = new + age * (old - new)
        return state._replace(**changed)

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


def _copy(state: CellState) -> CellState:
    values: Any = (None if each is None else each.copy() for each in state)
    return CellState(*values)
