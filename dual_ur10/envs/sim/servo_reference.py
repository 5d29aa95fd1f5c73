"""Motion that the controllers derive from targets: transport delay, time scaling and the servoj law."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ur_core.kernel import RowLoop, Struct
from ur_core.servoj import ServojLaw, ServojProfile
from ur_core.types import Array, Rows

_MOST_KEPT_BYTES = 2**25  # discretisations of the law

_NEVER = 2**40  # physics step at which a lost target arrives


class TargetDelay:
    """Latency, jitter and loss of targets on their way to the controllers, in whole physics steps.

    While a target is delayed, the one before it stays in force; targets never overtake each other.

    Args:
        n: Number of cells.
        substeps: Physics steps per tick.
    """

    def __init__(self, n: int, substeps: int) -> None:
        self.n, self.substeps = n, substeps
        self.latency = np.zeros((n, 2), dtype=np.int64)
        self.jitter = np.zeros((n, 2), dtype=np.int64)
        self.loss = np.zeros((n, 2))
        self._rngs = [np.random.default_rng(0) for _ in range(n)]
        self._held: Array = np.zeros((n, 1, 2, 6))
        self._arrivals = np.zeros((n, 1, 2), dtype=np.int64)

    @property
    def is_none(self) -> bool:
        """True if every target acts in its own tick, so that nothing has to be computed."""
        return not (self.latency.any() or self.jitter.any() or self.loss.any())

    def reset(self, q_rad: Array, rows: Rows, seeds: Sequence[int]) -> None:
        """Start `rows` with the target `q_rad`, (len(rows), 2, 6), in force, and a random stream each."""
        self._held[rows] = q_rad[:, None]
        self._arrivals[rows] = -_NEVER
        for row, seed in zip(rows.tolist(), seeds, strict=True):
            self._rngs[row] = np.random.default_rng(seed)

    def __call__(self, targets: Array) -> Array:
        """Return the target in force in each physics step, (n, ticks * substeps, 2, 6), for (n, ticks, 2, 6) sent."""
        ticks = targets.shape[1]
        sent = np.arange(ticks)[None, :, None] * self.substeps
        arrivals = np.broadcast_to(self.latency[:, None] + sent, (self.n, ticks, 2)).copy()
        if self.jitter.any() or self.loss.any():
            for row, rng in enumerate(self._rngs):
                arrivals[row] += rng.integers(0, self.jitter[row] + 1, (ticks, 2))
                arrivals[row][rng.random((ticks, 2)) < self.loss[row]] = _NEVER
        arrivals = np.concatenate([self._arrivals, arrivals], axis=1)
        known = np.concatenate([self._held, targets], axis=1)
        # The latest target that has arrived is in force. A target that a later one overtakes never acts.
        steps = np.arange(ticks * self.substeps)[:, None]
        latest = np.zeros((self.n, ticks * self.substeps, 2), dtype=np.int64)
        for order in range(1, known.shape[1]):
            np.copyto(latest, order, where=arrivals[:, order, None] <= steps)
        in_force: Array = known[np.arange(self.n)[:, None, None], latest, np.arange(2)]
        self._forget(known, arrivals, latest[:, -1], ticks * self.substeps)
        return in_force

    def _forget(self, known: Array, arrivals: NDArray[np.int64], latest: Rows, steps: int) -> None:
        """Keep the targets in force at the end, and those still on their way."""
        first = min(int(latest.min()), known.shape[1] - 1)
        self._held = known[:, first:]
        kept = arrivals[:, first:].copy()
        kept[kept < _NEVER] -= steps
        # A target older than the one in force must not come back into force for an arm whose window starts later.
        self._arrivals = np.where(np.arange(first, known.shape[1])[None, :, None] < latest[:, None], _NEVER, kept)


class TimeScaledTargets:
    """Interpolation of the targets of a task whose time is scaled down.

    The controllers' period is a small part of a scaled tick; here it is one physics step. The next targets are
    unknown, so a parabola extrapolates the last three.

    Args:
        n: Number of cells.
        substeps: Physics steps per tick.
        speed_factor: Rate of the task's time.
    """

    def __init__(self, n: int, substeps: int, speed_factor: float) -> None:
        # A value held for a control period lags by half of it, which is this part of the task's tick.
        ahead = (np.arange(substeps) + 0.5) / substeps - speed_factor / 2
        weights = [1.0 + ahead * (1.5 + 0.5 * ahead), -ahead * (2.0 + ahead), ahead * (0.5 + 0.5 * ahead)]
        self._weights: Array = np.array(weights)[:, :, None, None]
        self._past: Array = np.zeros((n, 2, 2, 6))

    def reset(self, q_rad: Array, rows: Rows) -> None:
        """Start `rows` with the target `q_rad`, (len(rows), 2, 6)."""
        self._past[rows] = q_rad[:, None]

    def __call__(self, targets: Array) -> Array:
        """Return targets of physics steps, (n, ticks * substeps, 2, 6), from those of ticks, (n, ticks, 2, 6)."""
        known = np.concatenate([self._past, targets], axis=1)
        self._past = known[:, -2:]
        last, before, first = known[:, 2:, None], known[:, 1:-1, None], known[:, :-2, None]
        curve: Array = self._weights[0] * last + self._weights[1] * before + self._weights[2] * first
        return curve.reshape(len(targets), -1, 2, 6)


class ReferenceMotion:
    """Reference motion of both arms in every physics step of a period.

    Args:
        rows: (n, 3 steps + 3, 12) positions before, speeds after and accelerations in every step, then the state.

    Attributes:
        q_rad: (n, steps, 12) positions before each step.
        qd_rad_s: (n, steps, 12) speeds after it.
        qdd_rad_s2: (n, steps, 12) accelerations in it.
        end_q_rad: (n, 12) positions after the last step.
        end_qd_rad_s: (n, 12) speeds of the law then.
    """

    def __init__(self, rows: Array) -> None:
        self.rows = rows
        steps = rows.shape[1] // 3 - 1
        self.q_rad, self.qd_rad_s, self.qdd_rad_s2 = (rows[:, k * steps : (k + 1) * steps] for k in range(3))
        self.end_q_rad, self.end_qd_rad_s = rows[:, -3], rows[:, -2]

    def __reduce__(self) -> tuple[type[ReferenceMotion], tuple[Array]]:
        return ReferenceMotion, (self.rows,)  # views of it again, not copies


class ServojReference:
    """Servoj law of every arm, and its motion at every physics step.

    Positions come from the exact discretisation. Speeds and accelerations are their differences over the physics step,
    as MuJoCo's semi-implicit integrator computes them: a servo that receives them follows the positions exactly if its
    model of the arm is right.

    Args:
        profile: Servoj settings.
        n: Number of cells.
        substeps: Physics steps per tick.
        ticks: Ticks per call.
        speed_factor: Rate of the targets' time; measured in it, the law is quicker by this factor.
        threads: Threads to compute on.
    """

    def __init__(
        self, profile: ServojProfile, n: int, substeps: int, ticks: int, speed_factor: float = 1.0, threads: int = 1
    ) -> None:
        self.profile, self.n, self.substeps, self.ticks = profile, n, substeps, ticks
        self._slow, self._threads = speed_factor, threads
        self.steps = ticks * substeps
        # Rows: position, speed, and the last difference of positions over the physics step.
        self._state: Array = np.zeros((n, 3, 12))
        self.motion = ReferenceMotion(np.zeros((n, 3 * self.steps + 3, 12)))
        """Motion of the last call."""
        self._cache: dict[tuple[float, int], Array] = {}
        self.set_lookahead(np.ones((n, 2)), delayed=False)

    def set_lookahead(self, scale: Array, *, delayed: bool) -> None:
        """Choose the true lookahead of each arm.

        Args:
            scale: (n, 2) factors on that of the profile.
            delayed: True if targets come per physics step instead of per tick.
        """
        hold = 1 if delayed else self.substeps
        unique, which = np.unique(scale, return_inverse=True)
        matrices = np.array([self._known(float(each), hold) for each in unique])
        _, outputs, inputs = matrices.shape
        self._targets: Array = np.zeros((self.n, inputs - 3, 2, 6))
        struct = Struct(
            "Reference",
            n=self.n,
            inputs=inputs,
            targets=inputs - 3,
            outputs=outputs,
            count=len(matrices),
            matrices=matrices,
            which=which.reshape(self.n, 2).astype(np.int64),
            state=self._state,
            target=self._targets,
            motion=self.motion.rows,
        )
        self._step = RowLoop("reference_step", struct, self.n, self._threads)

    def _known(self, scale: float, hold: int) -> Array:
        """Return a cached `_matrix`, which takes a millisecond to compute."""
        found = self._cache.get((scale, hold))
        if found is None:
            found = self._matrix(scale, hold)
            if (len(self._cache) + 1) * found.nbytes > _MOST_KEPT_BYTES:
                self._cache.clear()
            self._cache[scale, hold] = found
        return found

    def _matrix(self, scale: float, hold: int) -> Array:
        """Return the rows: positions before, speeds after and accelerations in every step; then the final state."""
        law = ServojLaw(self.profile.lookahead_s * scale * self._slow, self.profile.gain / self._slow**2)
        dt, steps = self.profile.tick_s / self.substeps, self.steps
        response = law.response(dt, steps, hold)
        inputs = 3 + response.shape[2] - 2
        position = np.zeros((steps + 1, inputs))
        position[0, 0] = 1.0
        position[1:, :2], position[1:, 3:] = response[:, 0, :2], response[:, 0, 2:]
        speed = np.diff(position, axis=0) / dt
        before = np.zeros((1, inputs))
        before[0, 2] = 1.0
        acceleration = np.diff(np.vstack([before, speed]), axis=0) / dt
        end = np.zeros((1, inputs))
        end[0, :2], end[0, 3:] = response[-1, 1, :2], response[-1, 1, 2:]
        return np.vstack([position[:-1], speed, acceleration, position[-1:], end, speed[-1:]])

    def reset(self, q_rad: Array, rows: Rows) -> None:
        """Start `rows` from rest at `q_rad`, (len(rows), 2, 6)."""
        self._state[rows] = 0.0
        self._state[rows, 0] = q_rad.reshape(-1, 12)

    def __call__(self, targets: Array) -> ReferenceMotion:
        """Return the motion of the next period: the same object at every call.

        Args:
            targets: (n, m, 2, 6), one per tick, or one per physics step after a delay.
        """
        self._targets[:] = targets
        self._step()
        return self.motion
