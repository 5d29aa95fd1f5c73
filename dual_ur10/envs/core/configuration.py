"""Check of a configuration of both arms: reach, joint margins, singularities, and what is in the way.

Distances and limits are those of the safety gate, so that what is in the way here is what the gate refuses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dual_ur10.assets.settings import home_q_rad
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.tasks.reach import FAR_M, nearest_in_reach, reach, tool_levers_m
from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.control.cartesian_step import HALT_CONDITION, SLOW_CONDITION, condition
from ur_core.kinematics.forward import flange_pose_quat
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, compose
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.types import Array

_SHOWN: Final = 5  # pairs of bodies in a printed report, at least
_SINGULAR: Final = 1e6  # condition number of what is printed as singular
_UNIT: Final = 1e-3  # deviation from 1 of the length of a quaternion


class PairClearance(NamedTuple):
    """Distance of a pair of bodies.

    Attributes:
        pair: Names of both, such as "left/forearm_link and table".
        distance_m: Distance; beyond 0.2 m as 0.2 m.
        allowed_m: Smallest legal distance.
    """

    pair: str
    distance_m: float
    allowed_m: float

    @property
    def spare_m(self) -> float:
        """Distance above the smallest legal one; negative: in the way."""
        return self.distance_m - self.allowed_m


@dataclass(frozen=True, eq=False)
class ConfigurationReport:
    """Findings of `check_configuration`. It prints as text.

    Attributes:
        env_id: Id of the environment whose cell, task and limits these are.
        q_rad: (2, 6) joint positions: those given, or those nearest to them that put the tools at their poses. Of an
            arm that does not reach its pose, those of the nearest pose of this orientation that it reaches.
        tools: Poses of both tools there in the cell frame, (2, 3) and (2, 4).
        missed_m: Distance of each tool from its wanted position; 0 where it is reached, and infinity where no position
            within 1 m is in reach in this orientation: `q_rad` are then those given.
        margin_rad: (2, 6) distance of each joint from the nearer end of its range; negative: outside.
        condition: (2,) condition number of the Jacobian of each flange, which is infinite at a singularity.
        clearances: All pairs of bodies that the safety gate measures, the least spare distance first.
    """

    env_id: str
    q_rad: Array
    tools: Poses
    missed_m: tuple[float, float]
    margin_rad: Array
    condition: Array
    clearances: tuple[PairClearance, ...]

    @property
    def reached(self) -> tuple[bool, bool]:
        """True for each arm that reaches its pose."""
        return self.missed_m[0] == 0.0, self.missed_m[1] == 0.0

    @property
    def in_the_way(self) -> tuple[PairClearance, ...]:
        """Pairs of bodies that are closer than allowed."""
        return tuple(each for each in self.clearances if each.spare_m < 0.0)

    @property
    def is_legal(self) -> bool:
        """True if both arms reach their poses, all joints are in their ranges, and nothing is in the way."""
        return all(self.reached) and not self.in_the_way and bool((self.margin_rad >= 0.0).all())

    def __str__(self) -> str:
        lines = [f"{self.env_id}: {'legal' if self.is_legal else 'not legal'}"]
        for arm, name in enumerate(ARMS):
            lines += self._of_arm(arm, name)
        blocked = self.in_the_way
        lines += [f"in the way: {_text(each)}" for each in blocked]
        lines += [f"near: {_text(each)}" for each in self.clearances[len(blocked) : max(_SHOWN, len(blocked) + 1)]]
        return "\n".join(lines)

    def _of_arm(self, arm: int, name: str) -> list[str]:
        missed_m, joint = self.missed_m[arm], int(self.margin_rad[arm].argmin())
        if missed_m == 0.0:
            reached = "tool at"
        elif missed_m <= FAR_M:
            reached = f"out of reach by {1e3 * missed_m:.0f} mm; the nearest position of this orientation is"
        else:
            reached = f"out of reach, also within {FAR_M:g} m in this orientation; these joint positions are at"
        margin = float(self.margin_rad[arm, joint])
        ends = "from the end of its range" if margin >= 0.0 else "beyond the end of its range"
        number = self.condition[arm]
        singular = f"condition number {number:.3g}" if number < _SINGULAR else "at a singularity"
        place, quat, q = (_numbers(each[arm]) for each in (*self.tools, self.q_rad))
        return [
            f"{name}: {reached} ({place}) m, quaternion ({quat})",
            f"  joint positions {q} rad; {JOINTS[joint]} is {abs(margin):.2f} rad {ends}",
            f"  {singular}; steps of the tool shrink from {SLOW_CONDITION:g} on, and end at {HALT_CONDITION:g}",
        ]


def check_configuration(
    task: str, *, q_rad: ArrayLike | None = None, tools: Poses | None = None, **keywords: Any
) -> ConfigurationReport:
    """Check where both arms are at a configuration, without moving or simulating anything.

    Args:
        task: Id of an environment, or a shorter name. Its tools, the props that grippers may hold, its limits, and the
            pairs of bodies that it allows to come closer count. "Free" is a cell with two grippers, and no such pairs
            but those of picking up.
        q_rad: (2, 6) joint positions of the left and the right arm. Left out: home. With `tools`, the joint positions
            to which those of the tools are the nearest ones.
        tools: Poses of both tools in the cell frame, (2, 3) and (2, 4): of the tool centre points of the grippers, or
            of the flanges in a task without.
        **keywords: Those of the environment, such as `cell`, `robot` and settings of the task. Of a cell of two
            controllers nothing is connected.

    Raises:
        UnknownNameError: There is no such environment.
        UnknownKeywordError: It has no such keyword.
        SettingsError: Or one of its kinds: a number is not finite, or its shape is another one, or a value of the
            keywords is not legal.
    """
    setup = EnvSetup.resolve(task, keywords)
    config = setup.config
    mounts, frames = (config.left, config.right), Frames((config.left, config.right))
    q = home_q_rad(mounts) if q_rad is None else _checked("q_rad", q_rad, (2, 6), "(2, 6) joint positions")
    missed = [0.0, 0.0]
    if tools is not None:
        wanted = Poses(
            _checked("position of the tools", tools[0], (2, 3), "(2, 3)"),
            _checked("quaternion of the tools", tools[1], (2, 4), "(2, 4)"),
        )
        norm = np.linalg.norm(wanted.quat, axis=1, keepdims=True)
        if (np.abs(norm - 1.0) > _UNIT).any():
            raise SettingsError(
                f"quaternions of the tools are {wanted.quat.tolist()}: each must have length 1, w first"
            )
        found = reach(config, Poses(wanted.position_m[None], wanted.quat[None] / norm), q)
        near, q = q, found.q_rad[0].copy()
        for arm in np.flatnonzero(~found.reached[0]).tolist():
            instead = nearest_in_reach(found.flange_m[0, arm], found.rotation[0, arm], near[arm], mounts[arm].dh)
            q[arm], missed[arm] = (near[arm], np.inf) if instead is None else instead
    flanges = [flange_pose_quat(q[arm], mount.dh) for arm, mount in enumerate(mounts)]
    position, quat = (np.stack(each) for each in zip(*flanges, strict=True))
    flange = Poses(frames.position_to_cell(position), frames.quat_to_cell(quat))
    clearance = setup.make_clearance()
    (distances,), (allowed,) = clearance.measure(q.reshape(1, 12))
    measured = zip(map(" and ".join, clearance.pairs), distances.tolist(), allowed.tolist(), strict=True)
    lower, upper = np.asarray(setup.limits.lower_rad), np.asarray(setup.limits.upper_rad)
    return ConfigurationReport(
        env_id=setup.env_id,
        q_rad=q,
        tools=compose(flange, Poses(tool_levers_m(config), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))),
        missed_m=(missed[0], missed[1]),
        margin_rad=np.minimum(q - lower, upper - q),
        condition=np.concatenate([condition(q[arm : arm + 1], mount.dh) for arm, mount in enumerate(mounts)]),
        clearances=tuple(sorted((PairClearance(*each) for each in measured), key=lambda each: each.spare_m)),
    )


def _checked(what: str, values: ArrayLike, shape: tuple[int, ...], allowed: str) -> Array:
    """Return numbers as an array of a shape.

    Raises:
        SettingsError: They are not finite numbers of this shape.
    """
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise SettingsError(f"{what} is {values!r:.200}: it must be {allowed} of both arms, finite numbers")
    return array


def _numbers(values: Array) -> str:
    return ", ".join(f"{value + 0.0:.3f}" for value in values)


def _text(each: PairClearance) -> str:
    far = "200 mm apart or more" if each.distance_m >= 0.2 else f"{1e3 * each.distance_m:.1f} mm apart"
    return f"{each.pair} are {far}, allowed are {1e3 * each.allowed_m:.1f} mm or more"
