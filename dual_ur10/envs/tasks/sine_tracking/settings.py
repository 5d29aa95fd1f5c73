"""Settings of `SineTracking`, and the check that two arms can follow its reference."""

from __future__ import annotations

import dataclasses
import itertools
from functools import lru_cache
from typing import Any, Literal, get_args

import numpy as np

from dual_ur10.assets.settings import SceneSettings, home_q_rad
from dual_ur10.envs.tasks.task import check_numbers
from dual_ur10.errors import SettingsError, UnknownNameError, WorkspaceError
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics import try_nearest
from ur_core.kinematics.frames import to_base
from ur_core.kinematics.rotations import quat_from_rotvec, quat_to_matrix
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.types import Array

Vector = tuple[float, float, float]
Axis = Literal["x", "y", "z"]
Arms = Literal["both", "left", "right"]

TOOL_DOWN_QUAT: Array = quat_from_rotvec(np.array([np.pi, 0.0, 0.0]))
"""Orientation of the flange in the arm's own `base` frame: its axis straight down."""

CENTER_RANGE_M = 0.05
"""Largest shift of the centre along each axis of the cell frame when an episode is randomised."""

FAR_CENTER_RANGE_M = 0.1
"""The same with `random_path`, for each arm's centre on its own."""

AMPLITUDE_RANGE_M, FREQUENCY_RANGE_HZ = (0.02, 0.12), (0.2, 0.8)
"""Amplitudes and frequencies of `random_path`."""

_ROUNDING_M = 1e-9
_SAMPLES = 25
_OVERSHOOT = 0.2  # of the amplitude: distance beyond a turning point at which a stop may end
_ROOM = 0.9  # of a speed limit, for the reference; corrections need the rest


@dataclasses.dataclass(frozen=True)
class SineSettings:
    """Keywords of `SineTracking`, described there.

    Raises:
        SettingsError: A value is not legal.
    """

    axis: Axis | Vector = "y"
    amplitude_m: float = 0.1
    frequency_hz: float = 0.5
    duration_s: float = 30.0
    soft_start_s: float = 2.0
    phase_rad: float = 0.0
    center_m: tuple[Vector, Vector] = ((0.0, 0.6, 0.4), (0.0, -0.6, 0.4))
    randomize: bool = True
    random_path: bool = False
    arms: Arms = "both"
    success_rms_m: float = 0.003

    def __post_init__(self) -> None:
        if isinstance(self.axis, str) and self.axis not in get_args(Axis):
            raise UnknownNameError("axis", self.axis, get_args(Axis), "a direction (x, y, z)")
        if self.arms not in get_args(Arms):
            raise UnknownNameError("arms", str(self.arms), get_args(Arms))
        check_numbers(
            self,
            ("amplitude_m", 0.0, 1.0),
            ("frequency_hz", 0.0, 5.0),
            ("duration_s", 0.1, 3600.0),
            ("soft_start_s", 0.1, 60.0),
            ("phase_rad", -100.0, 100.0),
            ("success_rms_m", 1e-6, 1.0),
        )
        for name in ("randomize", "random_path"):
            if not isinstance(getattr(self, name), bool | np.bool_):
                raise SettingsError(f"{name} is {getattr(self, name)!r}: it must be True or False")
        center = _vectors(self.center_m)
        if center.shape != (2, 3) or not np.isfinite(center).all():
            raise SettingsError(f"center_m is {self.center_m!r}: it must be a position (x, y, z) for each arm")
        left, right = (tuple(row) for row in center.tolist())
        object.__setattr__(self, "center_m", (left, right))
        if not isinstance(self.axis, str):
            axis = _vectors(self.axis)
            if axis.shape != (3,) or not np.isfinite(axis).all() or not np.linalg.norm(axis) > 0:
                raise SettingsError(f"axis is {self.axis!r}: it must be 'x', 'y', 'z' or a vector (x, y, z)")
            object.__setattr__(self, "axis", tuple((axis / np.linalg.norm(axis)).tolist()))

    @property
    def direction(self) -> Array:
        """Unit vector of the axis in the cell frame, (3,)."""
        if isinstance(self.axis, str):
            unit: Array = np.eye(3)[get_args(Axis).index(self.axis)]
            return unit
        return np.array(self.axis)

    @property
    def tracking(self) -> Array:
        """Factor of each arm, (2,): 1 if it follows the sine, 0 if it holds its centre."""
        return np.array([float(self.arms in ("both", arm)) for arm in ARMS])

    @property
    def peak_speed_m_s(self) -> float:
        """Largest speed of the reference at any phase, its soft start included."""
        time_s = np.linspace(0.0, self.soft_start_s, 200)
        x = time_s / self.soft_start_s
        growth, omega = x**3 * (10 - 15 * x + 6 * x * x), 2 * np.pi * self.frequency_hz
        rate = 30 * x * x * (1 - x) ** 2 / self.soft_start_s
        return float(self.amplitude_m * np.hypot(rate, growth * omega).max())

    def covered_by(self, trained: SineSettings) -> frozenset[str]:
        """Return the keywords whose values lie within the range that other settings with `random_path` sample."""
        if not trained.random_path:
            phase = trained.randomize and trained.center_m == self.center_m
            return frozenset({"phase_rad", "randomize"} if phase else ())
        names = {"axis", "phase_rad", "randomize", "random_path"}
        if AMPLITUDE_RANGE_M[0] <= self.amplitude_m <= AMPLITUDE_RANGE_M[1]:
            names.add("amplitude_m")
        if FREQUENCY_RANGE_HZ[0] <= self.frequency_hz <= FREQUENCY_RANGE_HZ[1]:
            names.add("frequency_hz")
        away = np.abs(np.asarray(self.center_m) - np.asarray(trained.center_m)).max()
        shift = FAR_CENTER_RANGE_M if self.random_path else CENTER_RANGE_M * self.randomize
        if away + shift <= FAR_CENTER_RANGE_M + _ROUNDING_M:
            names.add("center_m")
        return frozenset(names)

    def shifted(self, by_m: Array, **changes: Any) -> SineSettings:
        """Return these settings with both centres shifted by a vector, (3,), or by one each, (2, 3), and changed."""
        left, right = (np.asarray(self.center_m) + by_m).tolist()
        return dataclasses.replace(self, center_m=(tuple(left), tuple(right)), **changes)

    def displacement_m(self, time_s: Array, phase_rad: Array) -> Array:
        """Return the displacement along the axis. It begins at rest and without acceleration.

        Args:
            time_s: Times since the start.
            phase_rad: Phases, of a shape that broadcasts to that of `time_s`.
        """
        result: Array = self.amplitude_m * np.sin(time_s * (2 * np.pi * self.frequency_hz) + phase_rad)
        if np.minimum.reduce(time_s, axis=None) < self.soft_start_s:
            x = np.minimum(time_s / self.soft_start_s, 1.0)  # exactly 1 at the end and after it
            result *= x * x * x * (10.0 + x * (6.0 * x - 15.0))
        return result


def _vectors(values: object) -> Array:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        return np.zeros(0)


class SineCheck:
    """Check that two arms can follow a sine.

    Args:
        scene: Scene as measured.
        limits: Limits of motion.
        minimum_clearance_m: Smallest legal distance.
        uncertainty: See `dual_ur10.sim2real.control.clearance.Clearance`.
    """

    def __init__(
        self,
        scene: SceneSettings,
        limits: MotionLimits,
        minimum_clearance_m: float,
        uncertainty: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0)),
    ) -> None:
        self._scene, self._speed_limit = scene, _ROOM * np.asarray(limits.speed_rad_s)
        self._clearance = Clearance(scene, minimum_m=minimum_clearance_m, uncertainty=uncertainty)

    def __call__(self, settings: SineSettings) -> None:
        """Refuse a sine that the arms cannot follow at some centre of an episode.

        Raises:
            WorkspaceError: The path leaves the workspace, needs a joint faster than the task's limit allows, or comes
                closer to something than the safety gate lets it.
        """
        corners = itertools.product((-CENTER_RANGE_M, CENTER_RANGE_M), repeat=3)
        shifts = list(corners) if settings.randomize else [(0, 0, 0)]
        centers = np.asarray(settings.center_m)[None] + np.array(shifts)[:, None]
        paths = [_joint_path(settings, self._scene, arm, centers[:, arm]) for arm in range(2)]
        for arm, path in enumerate(paths):
            # Steps of the path are steps of the displacement; an arm that holds its centre makes none.
            step_m = 2 * settings.amplitude_m / (_SAMPLES - 1)
            speed = np.abs(np.diff(path, axis=0)).max(axis=(0, 1)) / max(step_m, 1e-12) * settings.peak_speed_m_s
            if (speed > self._speed_limit).any():
                joint = int((speed / self._speed_limit).argmax())
                raise WorkspaceError(
                    f"the sine needs {speed[joint]:.3g} rad/s of {ARMS[arm]}/{JOINTS[joint]}, allowed are "
                    f"{self._speed_limit[joint]:.3g} rad/s: choose a smaller amplitude_m or frequency_hz, or another "
                    "center_m"
                )
        configurations = np.stack(paths, axis=2)
        # The gate checks the end of a stop, which is beyond the turning points.
        beyond = _OVERSHOOT * (_SAMPLES - 1) / 2
        ends = [
            configurations[k] + beyond * (configurations[k] - configurations[inner]) for k, inner in ((0, 1), (-1, -2))
        ]
        flat = np.concatenate([configurations, np.stack(ends)]).reshape(-1, 12)
        close = np.flatnonzero(~self._clearance.is_clear(flat))
        if close.size:
            pair, distance, allowed = self._clearance.worst(flat[close[0]])
            raise WorkspaceError(
                f"on the sine's path {pair} come as close as {distance * 1e3:.1f} mm, allowed are "
                f"{allowed * 1e3:.1f} mm: choose a smaller amplitude_m, another center_m, or move the bases"
            )


path_check = lru_cache(maxsize=16)(SineCheck)
"""Function that returns a `SineCheck`, the same for the same cell."""

_TRIES = 200


def sample_path(settings: SineSettings, rng: np.random.Generator, check: SineCheck) -> SineSettings:
    """Return settings of one episode: random axis, amplitude, frequency, phase and centres that the arms can follow.

    Raises:
        WorkspaceError: None of 200 was possible.
    """
    for tried in range(1, _TRIES + 1):
        axis = rng.normal(size=3)
        changes = {
            "axis": tuple((axis / np.linalg.norm(axis)).tolist()),
            "amplitude_m": float(rng.uniform(*AMPLITUDE_RANGE_M)),
            "frequency_hz": float(rng.uniform(*FREQUENCY_RANGE_HZ)),
            "phase_rad": float(rng.uniform(-np.pi, np.pi)),
            "randomize": False,
        }
        # Each centre for itself: otherwise a network for both arms learns that they belong together.
        sampled = settings.shifted(rng.uniform(-FAR_CENTER_RANGE_M, FAR_CENTER_RANGE_M, (2, 3)), **changes)
        try:
            check(sampled)
        except WorkspaceError:
            if tried == _TRIES:
                raise
        else:
            break
    return sampled


def _joint_path(settings: SineSettings, scene: SceneSettings, arm: int, centers: Array) -> Array:
    """Return the joint positions along the sine about every centre, (samples, centres, 6)."""
    mount, (position, rotation) = scene.mounts[arm], to_base(scene.mounts)
    reach = settings.amplitude_m * settings.tracking[arm]
    down = np.broadcast_to(quat_to_matrix(TOOL_DOWN_QUAT), (len(centers), 3, 3))
    q, path = np.broadcast_to(home_q_rad(scene.mounts)[arm], (len(centers), 6)), []
    for offset in [0.0, *np.linspace(-reach, reach, _SAMPLES)]:
        world = centers + offset * settings.direction
        q, reached = try_nearest((world - position[arm]) @ rotation[arm].T, down, q, mount.dh)
        if not reached.all():
            x, y, z = world[~reached][0]
            raise WorkspaceError(
                f"the {ARMS[arm]} arm cannot reach ({x:.3f}, {y:.3f}, {z:.3f}) m with its tool down: choose a "
                "smaller amplitude_m, another center_m, or move the base"
            )
        path.append(q)
    return np.array(path[1:])
