"""Gains of the simulated joint servos, and the integrators that are stable with them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

from ur_core.errors import SettingsError, UnknownNameError
from ur_core.kinematics.dynamics import stretched_inertia_kg_m2
from ur_core.kinematics.frames import finite_floats

LEAST_GAIN: Final = 0.01
MOST_KP_NM_RAD: Final = 1e6
MOST_KV_NMS_RAD: Final = 1e5
"""Largest gains of a joint, fifty and a hundred times those of `STIFF`."""

Joints = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Gains:
    """Gains of the joint servos of a simulated or emulated UR10, from the base to the wrist.

    Other models have them in the ratio of their stretched arms' inertias; see `gains_of`.

    Attributes:
        kp_nm_rad: Stiffness, N·m/rad.
        kv_nms_rad: Damping, N·m·s/rad.
        name: Name in messages.

    Raises:
        SettingsError: They are not six numbers each from `LEAST_GAIN` to `MOST_KP_NM_RAD` and `MOST_KV_NMS_RAD`.
    """

    kp_nm_rad: Joints
    kv_nms_rad: Joints
    name: str = field(default="own", compare=False)

    def __post_init__(self) -> None:
        for name, most in (("kp_nm_rad", MOST_KP_NM_RAD), ("kv_nms_rad", MOST_KV_NMS_RAD)):
            values = finite_floats(f"{name} of gains", getattr(self, name), 6)
            if not all(LEAST_GAIN <= each <= most for each in values):
                raise SettingsError(f"{name} of gains is {values}: each must be {LEAST_GAIN:g} to {most:g}")
            object.__setattr__(self, name, values)


STIFF: Final = Gains(
    (20000.0, 20000.0, 10000.0, 3000.0, 3000.0, 3000.0), (1000.0, 1000.0, 500.0, 60.0, 60.0, 60.0), "stiff"
)
"""Gains for free motion."""

COMPLIANT: Final = Gains(
    (4000.0, 4000.0, 3500.0, 3200.0, 3200.0, 3200.0), (350.0, 350.0, 200.0, 30.0, 30.0, 30.0), "compliant"
)
"""Gains for tasks in which both arms hold one object."""

INTEGRATORS: Final = ("implicitfast", "Euler")
"""MuJoCo's integrators for the physics: "Euler" treats the damping of the servos explicitly."""

MOST_UNSTABLE: Final = 2.2
"""Largest stability number with which "Euler" is used. It diverges from 4 on. The rest is for lighter arms: an episode
may sample half of the links' masses, while the armature of the joints stays."""

# Largest eigenvalues of M^-1 kv (1/s) and M^-1 kp (1/s²) of a UR10 without gripper, over all configurations; and of
# those models whose eigenvalues are larger, a bound of their ratio.
_RATES: Final = {STIFF: (2735.0, 54800.0), COMPLIANT: (973.0, 32000.0)}
_RATE_RATIO: Final = {"ur8long": 1.28, "ur20": 1.06, "ur30": 1.06}


def check_gains(value: object) -> None:
    """Check that a setting holds gains.

    Raises:
        SettingsError: It does not.
    """
    if not isinstance(value, Gains):
        raise SettingsError(
            f"gains are {value!r:.80}: they must be Gains, such as STIFF and COMPLIANT of dual_ur10.tasks"
        )


@lru_cache(maxsize=64)
def gains_of(robot: str, gains: Gains) -> tuple[Joints, Joints]:
    """Return kp and kv of a model's joints: those of a UR10, as many times as large as its stretched arm's inertia.

    So every joint of every model answers at about the same rate and with the same damping.

    Args:
        robot: Name of the model.
        gains: Those of a UR10.
    """
    kp, kv = gains.kp_nm_rad, gains.kv_nms_rad
    if robot == "ur10":
        return kp, kv
    ratio = stretched_inertia_kg_m2(robot) / stretched_inertia_kg_m2("ur10")
    kp, kv = (tuple((ratio * each).tolist()) for each in (kp, kv))
    return kp, kv


def stability_number(gains: Gains, timestep_s: float, mass_scale: float = 1.0, *, robots: Collection[str]) -> float:
    """Return an upper bound, over all configurations, of the largest eigenvalue of M^-1 (2 h kv + h² kp).

    Explicit integration of the servos diverges if it reaches 4. For gains of one's own it follows from those that were
    measured: no eigenvalue grows by more than the largest ratio of two gains of one joint.

    Args:
        gains: Those of a UR10.
        timestep_s: Physics timestep h.
        mass_scale: Factor on the links' masses.
        robots: Models of the arms.
    """
    damping = min(rate * _largest_ratio(gains.kv_nms_rad, known.kv_nms_rad) for known, (rate, _) in _RATES.items())
    stiffness = min(rate * _largest_ratio(gains.kp_nm_rad, known.kp_nm_rad) for known, (_, rate) in _RATES.items())
    ratio = max(_RATE_RATIO.get(robot, 1.0) for robot in robots)
    return ratio * (2 * timestep_s * damping + timestep_s**2 * stiffness) / min(mass_scale, 1.0)


def _largest_ratio(gains: Joints, known: Joints) -> float:
    return max(own / other for own, other in zip(gains, known, strict=True))


def check_integrator(
    integrator: str, gains: Gains, timestep_s: float, mass_scale: float = 1.0, *, robots: Collection[str]
) -> None:
    """Refuse "Euler" where it is unstable or close to it.

    Raises:
        UnknownNameError: There is no such integrator.
        SettingsError: It is "Euler", and its stability number is too large.
    """
    if integrator not in INTEGRATORS:
        raise UnknownNameError("integrator", str(integrator), INTEGRATORS)
    number = stability_number(gains, timestep_s, mass_scale, robots=robots)
    if integrator == "Euler" and number > MOST_UNSTABLE:
        raise SettingsError(
            f'integrator="Euler" with gains={gains.name!r}, timestep_s={timestep_s:g} and masses times {mass_scale:g}: '
            f"its stability number is up to {number:.2f}, allowed are {MOST_UNSTABLE}, and it diverges from 4 on. Use "
            'integrator="implicitfast", gains=COMPLIANT or a shorter timestep_s'
        )
