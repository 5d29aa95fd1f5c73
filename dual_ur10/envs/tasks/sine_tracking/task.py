"""SineTracking: both flanges follow one sine, at the same time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from dual_ur10.assets.settings import home_q_rad
from dual_ur10.envs.tasks.geometry import Goal, GoalSteps, frame_of, length
from dual_ur10.envs.tasks.observation_layout import (
    ARM_FIELDS,
    Field,
    ObservationLayout,
    arm_values,
    pose_fields,
    pose_values,
)
from dual_ur10.envs.tasks.sine_tracking.settings import (
    CENTER_RANGE_M,
    TOOL_DOWN_QUAT,
    SineSettings,
    path_check,
    sample_path,
)
from dual_ur10.envs.tasks.sine_tracking.tracking import Tracked, Tracking
from dual_ur10.envs.tasks.task import Outcome, Task, Timing, gaussian
from dual_ur10.sim2real.cell.cell import CellState, Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics import nearest
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import quat_to_matrix
from ur_core.types import Array, Rows

_NEAR_M, _FAR_M = 0.012, 0.03  # errors at which the terms "position" and "approach" have fallen to their halves
_APART_M = 0.005  # error of the vector between the flanges at which the factor of the term "synchrony" is 0.1
_NOW_AHEAD_NOW = np.array([0, 1, 0])[:, None, None]
_LEVER_M = 0.5  # distance that an angle counts as, per rad: 0.02 rad as 10 mm
_LATE_S = 0.1  # time that an error of the velocity counts for: 31 mm for arms at rest where the default sine is fastest


class SineMeasured(NamedTuple):
    """References and errors at one instant.

    Attributes:
        reference_base_m: (n, 2, 3) reference positions of the flanges in each arm's own `base` frame.
        ahead_base_m: (n, 2, 3) references at the end of the next motion in that frame.
        reference_m: (n, 2, 3) reference positions of the flanges in the cell frame.
        errors: Errors of the flanges; rotations in their own `base` frames.
    """

    reference_base_m: Array
    ahead_base_m: Array
    reference_m: Array
    errors: Tracked


class SineTracking(Task[SineSettings, SineMeasured]):
    """Both flanges follow a sine along one axis, synchronously, with their tools pointing straight down.

    ## Description

    The simplest task that measures a dual-arm cell. A sine of 0.1 m at 0.5 Hz has a peak speed of 0.31 m/s, at which
    the lag of `servoj`, 34 ms, causes an error of 10 mm. The sine begins smoothly from rest. Both arms share time, axis and phase, so that the
    vector from flange to flange is constant.

    ## Action Space

    The action space is a `Box(-1.0, 1.0, (12,), float32)` with the default `action_mode="joint_delta"`: steps of the
    twelve joints from the last command, in fractions of the speed limit (1.2 rad/s) times the period (40 ms).

    The table shows the left arm; the right arm's numbers follow in the same order.

    | Num | Action | Control Min | Control Max | Name (in XML file) | Joint | Type (Unit) |
    |-----|--------|-------------|-------------|--------------------|-------|-------------|
    | 0 | step of the shoulder pan | -1 | 1 | left/shoulder_pan_joint | hinge | fraction of 0.048 (rad) |
    | 1 | step of the shoulder lift | -1 | 1 | left/shoulder_lift_joint | hinge | fraction of 0.048 (rad) |
    | 2 | step of the elbow | -1 | 1 | left/elbow_joint | hinge | fraction of 0.048 (rad) |
    | 3 | step of the wrist 1 | -1 | 1 | left/wrist_1_joint | hinge | fraction of 0.048 (rad) |
    | 4 | step of the wrist 2 | -1 | 1 | left/wrist_2_joint | hinge | fraction of 0.048 (rad) |
    | 5 | step of the wrist 3 | -1 | 1 | left/wrist_3_joint | hinge | fraction of 0.048 (rad) |

    ## Observation Space

    The observation space is a `Box(low, high, (94,), float64)` with the bounds of the table: 47 numbers of the left
    arm, which the table shows, then the same 47 of the right arm, with left and right exchanged. All of them can be
    measured on a real cell. Poses are in the arm's own `base` frame, the one in which UR's controller reports its TCP;
    quaternions are (w, x, y, z).

    | Num | Observation | Min | Max | Name (in XML file) | Type (Unit) |
    |-----|-------------|-----|-----|--------------------|-------------|
    | 0-5 | joint positions | -6.5 | 6.5 | left/shoulder_pan_joint ... left/wrist_3_joint | angle (rad) |
    | 6-11 | joint speeds | -10 | 10 | left/shoulder_pan_joint ... left/wrist_3_joint | speed (rad/s) |
    | 12-17 | commanded joint positions | -6.5 | 6.5 | left/shoulder_pan_joint ... left/wrist_3_joint | angle (rad) |
    | 18-20 | position of the flange | -2 | 2 | left/flange | position (m) |
    | 21-24 | orientation of the flange | -1.01 | 1.01 | left/flange | quaternion |
    | 25-27 | reference of the flange now | -10 | 10 | - | position (m) |
    | 28-30 | reference of the flange at the end of the next motion | -10 | 10 | - | position (m) |
    | 31-33 | rotation vector from the flange to its reference, if small | -2.01 | 2.01 | - | angle (rad) |
    | 34-36 | translation from the commanded flange to its reference at the end of the next motion | -12 | 12 | - | position (m) |
    | 37-39 | rotation vector from the commanded flange to its reference, if small | -2.01 | 2.01 | - | angle (rad) |
    | 40-42 | position of the other flange in this arm's base frame | -5 | 5 | right/flange | position (m) |
    | 43-46 | orientation of the other flange in this arm's base frame | -1.01 | 1.01 | right/flange | quaternion |

    An agent of the two-agent environment observes its arm's numbers.

    With `observation="goals"` the observation space is a `Box(-1.0, 1.0, (36,), float32)`: 18 numbers of the left arm,
    then those of the right arm. A value x is shown as x / (u + abs(x)), in each unit u that the table names
    (`dual_ur10.envs.tasks.observation_layout.ConciseView`).

    | Num | Observation | Min | Max | Name (in XML file) | Type (Unit) |
    |-----|-------------|-----|-----|--------------------|-------------|
    | 0-5 | commanded joint positions, from home | -1 | 1 | left/shoulder_pan_joint ... left/wrist_3_joint | angle (rad) in 1 |
    | 6-11 | translation from the commanded flange to its reference at the end of the next motion | -1 | 1 | - | position (m) in 0.1 and 0.01 |
    | 12-17 | rotation vector from the commanded flange to its reference, if small | -1 | 1 | - | angle (rad) in 0.3 and 0.03 |

    ## Rewards

    The reward is the weighted sum of terms between 0 and 1; each raw term is in `info` as `reward/<term>`.

    All of them depend on one error of each arm: distance from the reference, plus 0.5 m times the angle, plus 0.1 s times
    the error of the velocity over the last period. So arms at rest earn little where the reference passes them, and those
    that follow it some millimetres off earn more than half.

    - *approach* (0.15): mean over the arms of 30 mm / (30 mm + error). It leads from any distance in the workspace.
    - *position* (0.75): mean over the arms of 1 / (1 + (error / 12 mm)²).
    - *synchrony* (0.1): *position* of one arm times that of the other, times 0.1^((error of the vector from flange to
      flange / 5 mm)²). One arm alone cannot earn it, nor can two that stand still.

    `info["is_success"]` is true at the end of an episode in which the root mean square error of both flanges over all
    steps is at most `success_rms_m`; `info["flange_rms_m"]` is the value of each arm so far.

    ## Starting State

    Both arms at rest with their flanges at the centres of the sine. With `randomize`, the phase is uniform on the
    circle, and both centres are shifted by the same vector, uniform within ±0.05 m along each axis.

    With `random_path`, axis (any direction), amplitude (0.02 to 0.12 m), frequency (0.2 to 0.8 Hz) and phase are uniform,
    and each centre is shifted on its own within ±0.1 m along each axis. A path that the arms cannot follow is drawn again. `info["randomization"]`
    has the values.

    ## Episode End

    ### Termination

    `info["end_reason"]` is "refused/<limit>" if the safety gate refused a motion and `on_refusal="terminate"`
    (`info["safety"]` gives the details), and "physics" if the simulation diverged (`info["physics_error"]`).

    ### Truncation

    After `duration_s`, 750 steps with the defaults, with the reason "success" or "time". No time limit is registered
    with the id; `env.spec.max_episode_steps` is this number.

    ## Arguments

    | Parameter | Type | Default | Description |
    |-----------|------|---------|-------------|
    | `axis` | str or 3 numbers | `"y"` | direction of the sine in the cell frame; "y" is the line between the flanges |
    | `amplitude_m` | float | `0.1` | amplitude (m) |
    | `frequency_hz` | float | `0.5` | frequency (Hz) |
    | `duration_s` | float | `30.0` | length of an episode (s) |
    | `soft_start_s` | float | `2.0` | time in which the amplitude grows to its value (s) |
    | `phase_rad` | float | `0.0` | phase, if not randomised (rad) |
    | `center_m` | 2 positions | `((0, 0.6, 0.4), (0, -0.6, 0.4))` | centre of each flange's sine in the cell frame (m) |
    | `randomize` | bool | `True` | sample phase and centre at every reset |
    | `random_path` | bool | `False` | sample the sine at every reset, see Starting State |
    | `arms` | str | `"both"` | "both", "left" or "right": an arm that does not track holds its centre |
    | `success_rms_m` | float | `0.003` | largest root mean square error of a success (m) |

    Those of every environment are described in `dual_ur10.envs.core.options.EnvOptions`.

    ## Version History

    - v0: first version.
    """

    limits: MotionLimits = MotionLimits(
        speed_rad_s=(1.2,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0, tcp_speed_m_s=1.5
    )
    accepted: ClassVar[dict[str, str]] = {
        "both as the left arm": "both references move alike, so that equal actions follow both",
    }
    weights: ClassVar[dict[str, float]] = {"approach": 0.15, "position": 0.75, "synchrony": 0.1}
    per_arm: ClassVar[tuple[str, ...]] = ("flange_error_m", "flange_rms_m", "orientation_error_rad", "reference_m")
    settings_type: ClassVar[type[SineSettings]] = SineSettings
    layout: ObservationLayout = ObservationLayout(
        *ARM_FIELDS,
        Field("reference_base_m", 3, -10.0, 10.0, "position (m)", "reference of the flange now"),
        Field("ahead_base_m", 3, -10.0, 10.0, "position (m)", "reference of the flange at the end of the next motion"),
        Field("rotation", 3, -2.01, 2.01, "angle (rad)", "rotation vector from the flange to its reference, if small"),
        Field(
            "step_m",
            3,
            -12.0,
            12.0,
            "position (m)",
            "translation from the commanded flange to its reference at the end of the next motion",
            concise=(0.1, 0.01),
        ),
        Field(
            "step_rad",
            3,
            -2.01,
            2.01,
            "angle (rad)",
            "rotation vector from the commanded flange to its reference, if small",
            concise=(0.3, 0.03),
        ),
        *pose_fields("other_flange_base", "the other flange in this arm's base frame", "{other}/flange", 5.0),
    )

    def __init__(self, settings: SineSettings, cell: CellConfig, timing: Timing, n: int) -> None:
        super().__init__(settings, cell, timing, n)
        mounts = (cell.left, cell.right)
        self._check = path_check(cell.measured_scene, self.limits, cell.minimum_clearance_m, cell.uncertainty)
        self._check(settings)
        frames = Frames(mounts)
        self._base_m, self._to_base = frames.base_m, frames.rotation
        self._track = Tracking(n, frames, np.stack([TOOL_DOWN_QUAT] * 2))
        self.horizon = self._duration = max(1, math.ceil(settings.duration_s / timing.period_s - 1e-9))
        # Of the sine, in `base` now and ahead, and in the cell frame: centres and amplitudes.
        self._center: Array = np.zeros((n, 3, 2, 3))
        self._along: Array = np.zeros((n, 3, 2, 3))
        # Now and ahead, (n, 2): angular frequencies, and phases at the start.
        self._omega, self._phase = np.zeros((n, 2)), np.zeros((n, 2))
        self._when = np.array([0.0, timing.ahead_s])
        self._steps = GoalSteps(n, 2, (Goal(0), Goal(1)), mounts, in_bases=True, tcp_m=(0.0, 0.0))
        self._ahead: Array = np.tile(frame_of(Poses(np.zeros(3), TOOL_DOWN_QUAT)), (n, 2, 1))
        self._squares: Array = np.zeros((n, 2))
        self._away_m: Array = np.zeros((n, 2, 3))  # from references to flanges, one period ago
        self._count = np.zeros(n, dtype=np.int64)

    def start(self, rows: Rows, rngs: Sequence[np.random.Generator]) -> Start:
        """Sample phase, centre and, with `random_path`, the sine itself. The flanges start at the centres."""
        given, sampled = self.settings, []
        for row, rng in zip(rows.tolist(), rngs, strict=True):
            if given.random_path:
                settings = sample_path(given, rng, self._check)
                sampled.append(settings)
            elif given.randomize:
                shift = rng.uniform(-CENTER_RANGE_M, CENTER_RANGE_M, 3)
                settings = given.shifted(shift, phase_rad=float(rng.uniform(-np.pi, np.pi)))
            else:
                settings = given
            world = np.asarray(settings.center_m)
            self._center[row] = np.stack([*[(self._to_base @ (world - self._base_m)[..., None])[..., 0]] * 2, world])
            along_base = self._to_base @ settings.direction
            self._along[row] = np.stack([along_base, along_base, np.tile(settings.direction, (2, 1))])
            self._along[row] *= settings.amplitude_m * settings.tracking[:, None]
            omega = 2 * math.pi * settings.frequency_hz
            self._omega[row] = omega
            self._phase[row] = settings.phase_rad + omega * self._when
        self._squares[rows] = self._away_m[rows] = 0.0
        self._count[rows] = 0
        mounts = self.cell.left, self.cell.right
        home, down = home_q_rad(mounts), np.broadcast_to(quat_to_matrix(TOOL_DOWN_QUAT), (len(rows), 3, 3))
        configurations = [
            nearest(self._center[rows, 0, arm], down, home[arm], mount.dh) for arm, mount in enumerate(mounts)
        ]
        names = ("axis", "amplitude_m", "frequency_hz", "center_m") if sampled else ()
        return Start(
            np.stack(configurations, axis=1),
            sampled={name: np.array([getattr(each, name) for each in sampled]) for name in names},
        )

    def measure(self, state: CellState) -> SineMeasured:
        """Compute reference and errors of all cells."""
        time_s, soft_start_s = state.time_s[:, None], self.settings.soft_start_s
        away = np.sin(time_s * self._omega + self._phase)
        if (time_s.item() if self.n == 1 else time_s.min()) < soft_start_s:
            x = np.minimum((time_s + self._when) / soft_start_s, 1.0)  # exactly 1 at the end and after it
            away *= x * x * x * (10.0 + x * (6.0 * x - 15.0))
        references = self._center + away.take(_NOW_AHEAD_NOW, axis=1) * self._along
        here, ahead, reference_m = references[:, 0], references[:, 1], references[:, 2]
        in_bases = Poses(state.flange_base_m, state.flange_base_quat)
        errors = self._track(state.flange_m, in_bases, reference_m)
        return SineMeasured(here, ahead, reference_m, errors)

    def observe(self, state: CellState, measured: SineMeasured, commanded_q_rad: Array) -> Array:
        """Assemble the observations, (n, 94)."""
        self._ahead[..., :3] = measured.ahead_base_m
        steps = self._steps(commanded_q_rad, self._ahead)
        return self.layout.join(
            {
                **arm_values(state, commanded_q_rad),
                "reference_base_m": measured.reference_base_m,
                "ahead_base_m": measured.ahead_base_m,
                "rotation": measured.errors.turn,
                "step_m": steps.move_m,
                "step_rad": steps.turn,
                **pose_values("other_flange_base", measured.errors.other_flange),
            }
        )

    @classmethod
    def covered(cls, trained: SineSettings, settings: SineSettings) -> frozenset[str]:
        """Return the keywords whose values lie within the range that a training with other settings sampled."""
        return settings.covered_by(trained)

    def evaluate(self, state: CellState, measured: SineMeasured) -> Outcome:
        """Evaluate reward terms, success and end."""
        errors = measured.errors
        terms = np.empty((self.n, 2, len(self.weights)))
        away_m = state.flange_m - measured.reference_m
        moved_m, self._away_m = length(away_m - self._away_m), away_m
        error_m = errors.off_m + _LEVER_M * errors.chord + (_LATE_S / self.timing.period_s) * moved_m
        near = error_m / _NEAR_M
        position = 1.0 / (1.0 + near * near)
        terms[..., 0] = _FAR_M / (_FAR_M + error_m)
        terms[..., 1] = position
        terms[..., 2] = (position[:, 0] * position[:, 1] * gaussian(errors.apart_m, _APART_M))[:, None]
        self._squares += errors.off_m * errors.off_m
        self._count += 1
        over = self._count >= self._duration
        success = over.copy()
        if np.count_nonzero(over):
            success = over & (self._squares.max(axis=1) <= self.settings.success_rms_m**2 * self._count)
        info = {
            "flange_error_m": errors.off_m,
            "flange_rms_m": np.sqrt(self._squares / self._count[:, None]),
            "orientation_error_rad": errors.chord,
            "reference_m": measured.reference_m,
        }
        return Outcome(terms, success, over, info)
