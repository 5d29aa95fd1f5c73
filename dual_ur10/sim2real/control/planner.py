"""Collision-free paths of both arms in joint space, over the distances of the safety gate.

The direct ways are tried first: straight, then one arm after the other. Where none is free, two trees grow towards each
other from both ends (RRT-Connect: Kuffner and LaValle, ICRA 2000), and shortcuts remove most of the corners.

The margin is one of joint angles: each pair of bodies keeps as much more than its smallest legal distance as all joints
together could use up within `MARGIN_RAD`. So an arm stays far from the other one, for which a small angle is a large
distance, while its wrists may still pass its own forearm, where there is no more room than 9 mm.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Final

import numpy as np

from dual_ur10.errors import PlanningError
from dual_ur10.sim2real.control.gate import Distances
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kernel import call
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.types import Array

MARGIN_RAD: Final = 0.003
"""Margin of a path: 12 mm between an arm and the table, 24 mm between both arms, 0.4 mm between wrist 3 and forearm."""

TOLERANCE_RAD: Final = 0.0015
"""Part of the margin that may be used up between two measured configurations."""

ITERATIONS: Final = 10_000
"""Largest number of samples, about 1 s of CPU time. Of 1,000 random pairs in the default cell, none needed half of
them."""

_RANGE_RAD: Final = 0.1  # sampled configurations stay as far from the ends of the joint range
_AROUND_RAD: Final = np.pi  # samples are at most this far beyond both ends: half a revolution meets all directions
_LEAST_RAD: Final = 0.02  # shorter branches are not kept
_SHORTCUTS: Final = 60
_CHECKED_SAMPLES: Final = 201  # configurations of a straight path, for a message

# Weights of the joints in the distance between configurations: rounded reach of what each one moves, in m.
_WEIGHTS: Final = np.tile([1.5, 1.5, 1.0, 0.4, 0.3, 0.1], 2)


def plan_path(
    distances: Distances,
    start_rad: Array,
    goal_rad: Array,
    limits: MotionLimits,
    rng: np.random.Generator,
    *,
    arms: Sequence[str] = ARMS,
    iterations: int = ITERATIONS,
) -> Array:
    """Return corners, (k, 12), of a path of straight parts in joint space on which all pairs keep the margin.

    Pairs that are nearer at one end only separate on the way from there. The gate therefore releases slow motion along
    the path, from a start that is too close with the distances of `retreat_clearance`.

    Args:
        distances: Computes distances.
        start_rad: (2, 6) or (12,) first configuration, which may be too close.
        goal_rad: Last configuration.
        limits: Limits whose joint range holds.
        rng: Generator of the samples.
        arms: Arms that move; the others stay at the start.
        iterations: Largest number of samples.

    Raises:
        PlanningError: An end is outside the joint range, the goal moves an arm that has to stay, it is too close and
            not on the straight way of arms that only separate, or no path was found.
    """
    start, goal = (np.array(each, dtype=np.float64).reshape(12) for each in (start_rad, goal_rad))
    space = _Space(distances, limits, arms)
    space.check(start, goal)
    if space.proven(start, goal)[0] >= 1.0:  # also where arms that are too close separate a little
        return np.array([start, goal])
    space.check_distances(goal)
    for corners in _direct(start, goal):
        if space.is_clear(corners):
            return np.array(corners)
    trees = _Tree(start, iterations), _Tree(goal, iterations)
    found = _connected(space, *trees, rng, iterations)
    if found is None:
        reached = [len(each) - 1 for each in trees]
        raise PlanningError(
            f"no path was found from the start to the goal with {iterations} samples: {reached[0]} configurations were "
            f"reached from the start, and {reached[1]} from the goal. On the straight path "
            f"{nearest_on_straight(distances, start, goal)}. Bring the arms nearer to the goal by hand, or choose "
            "other joint angles"
        )
    return _shortened(found, space, rng)


def _direct(start: Array, goal: Array) -> list[list[Array]]:
    left_first, right_first = np.append(goal[:6], start[6:]), np.append(start[:6], goal[6:])
    return [[start, goal], [start, left_first, goal], [start, right_first, goal]]


def nearest_on_straight(distances: Distances, start_rad: Array, goal_rad: Array) -> str:
    """Return the pair that has the least to spare on the straight path between two configurations, in words."""
    start, goal = np.reshape(start_rad, 12), np.reshape(goal_rad, 12)
    along = start + np.linspace(0.0, 1.0, _CHECKED_SAMPLES)[:, None] * (goal - start)
    pair, distance, allowed = min((distances.worst(q) for q in along), key=lambda found: found[1] - found[2])
    return f"{pair} would come within {1e3 * distance:.0f} mm, allowed are {1e3 * allowed:.0f} mm"


class _Space:
    """Configurations of both arms, and the straight paths between them that are clear."""

    def __init__(self, distances: Distances, limits: MotionLimits, arms: Sequence[str]) -> None:
        self._distances, self._kernel = distances, distances.kernel
        levers: Array = np.reshape(self._kernel.values["levers"], (-1, 12)).sum(axis=1)
        # Above 0 for pairs that no joint moves against each other, too.
        self._margin, self._tolerance = MARGIN_RAD * levers, TOLERANCE_RAD * levers + 1e-9
        self._lower, self._upper = np.tile(limits.lower_rad, 2), np.tile(limits.upper_rad, 2)
        self._moves = np.repeat([each in arms for each in ARMS], 6)

    def check(self, start: Array, goal: Array) -> None:
        """Refuse ends that no path can have.

        Raises:
            PlanningError: See `plan_path`.
        """
        for name, q in (("start", start), ("goal", goal)):
            outside = ~((q >= self._lower) & (q <= self._upper))  # NaN, too
            if outside.any():
                joint = int(outside.argmax())
                raise PlanningError(
                    f"{name}: {ARMS[joint // 6]}/{JOINTS[joint % 6]} is at {q[joint]:.3f} rad, allowed are "
                    f"{self._lower[joint]:.3f} to {self._upper[joint]:.3f}: choose other joint angles"
                )
        stays = ~self._moves & (start != goal)
        if stays.any():
            joint = int(stays.argmax())
            raise PlanningError(
                f"the {ARMS[joint // 6]} arm has to stay, but the goal differs in {JOINTS[joint % 6]}: "
                f"{goal[joint]:.3f} rad, at the start {start[joint]:.3f}. Plan for both arms"
            )

    def check_distances(self, goal: Array) -> None:
        """Refuse a goal that is too close.

        Raises:
            PlanningError: See `plan_path`.
        """
        pair, distance, allowed = self._distances.worst(goal)
        if not distance >= allowed:
            raise PlanningError(
                f"in the goal {pair} would be {1e3 * distance:.1f} mm apart, allowed are {1e3 * allowed:.1f} mm or "
                "more: choose another goal"
            )

    def proven(self, first: Array, last: Array) -> tuple[float, float]:
        """Return how far a straight path is proven clear, as fractions of it.

        Up to the first fraction no pair comes nearer than the margin, or than it was before. At the second one, all
        pairs keep the margin.
        """
        path, fractions = np.concatenate([first, last]), np.empty(2)
        call("clear_fractions", self._kernel, path, self._margin, self._tolerance, fractions, 1)
        self._kernel.check()
        clear, kept = fractions.tolist()
        return clear, kept

    def is_clear(self, corners: Sequence[Array]) -> bool:
        """Return True if a path is clear, and all pairs keep the margin at all corners but its ends."""
        if len(corners) == 2:
            forth, back = self.proven(*corners)[0], self.proven(*corners[::-1])[0]
            return max(forth, back, forth + back) >= 1.0
        return all(self.keeps_margin(corners, k, k + 1) for k in range(len(corners) - 1))

    def keeps_margin(self, corners: Sequence[Array], first: int, last: int) -> bool:
        """Return True if the straight path between two corners, of which one is no end, is clear.

        It is proven from its end of the path, where pairs may be nearer than the margin.
        """
        ends = (first, last) if last < len(corners) - 1 else (last, first)
        return self.proven(*(corners[k] for k in ends))[1] >= 1.0

    def around(self, start: Array, goal: Array) -> tuple[Array, Array]:
        """Return the least and the largest joint angles to sample between two ends."""
        least, largest = np.minimum(start, goal), np.maximum(start, goal)
        lower = np.minimum(np.maximum(least - _AROUND_RAD, self._lower + _RANGE_RAD), least)
        upper = np.maximum(np.minimum(largest + _AROUND_RAD, self._upper - _RANGE_RAD), largest)
        return np.where(self._moves, lower, start), np.where(self._moves, upper, start)


class _Tree:
    """Configurations reached from one end.

    Args:
        root: The end.
        most: Largest number of further ones.
    """

    def __init__(self, root: Array, most: int) -> None:
        self._q, self._weighted = np.empty((2, most + 1, 12))
        self._q[0], self._weighted[0] = root, root * _WEIGHTS
        self._parents = [-1]

    def __len__(self) -> int:
        return len(self._parents)

    def grow(self, goal: Array, space: _Space) -> int:
        """Grow a branch from the nearest configuration as far towards another one as is clear.

        Returns:
            The new end of the branch; -1 if it is too short.
        """
        away = self._weighted[: len(self)] - goal * _WEIGHTS
        nearest = int(np.einsum("ij,ij->i", away, away).argmin())
        base = self._q[nearest]
        _, kept = space.proven(base, goal)
        if kept < 1.0 and kept * float(np.abs(goal - base).max()) < _LEAST_RAD:
            return -1
        new = len(self)
        self._q[new] = goal if kept >= 1.0 else base + kept * (goal - base)
        self._weighted[new] = self._q[new] * _WEIGHTS
        self._parents.append(nearest)
        return new

    def at(self, node: int) -> Array:
        """Return a configuration."""
        result: Array = self._q[node]
        return result

    def branch(self, node: int) -> list[Array]:
        """Return the configurations from one up to the root."""
        found = []
        while node >= 0:
            found.append(self._q[node])
            node = self._parents[node]
        return found


def _connected(
    space: _Space, first: _Tree, second: _Tree, rng: np.random.Generator, iterations: int
) -> list[Array] | None:
    """Grow two trees towards each other, and return the corners of the path on which they meet; None: they do not."""
    lower, upper = space.around(first.at(0), second.at(0))
    tree, other = first, second
    for _ in range(iterations):
        new = tree.grow(rng.uniform(lower, upper), space)
        met = other.grow(tree.at(new), space) if new >= 0 else -1
        if met >= 0 and (other.at(met) == tree.at(new)).all():
            ends = (new, met) if tree is first else (met, new)
            return first.branch(ends[0])[::-1] + second.branch(ends[1])[1:]
        tree, other = other, tree
    return None


def _shortened(corners: list[Array], space: _Space, rng: np.random.Generator) -> Array:
    """Return a shorter path: random shortcuts, and no corner that can be left out."""
    corners = _without_detours(corners, space)
    for _ in range(_SHORTCUTS):
        lengths = [float(np.abs(np.diff(ends, axis=0)).max()) for ends in itertools.pairwise(corners)]
        passed = np.append(0.0, np.cumsum(lengths))
        cut = np.sort(rng.uniform(0.0, passed[-1], 2))
        first, last = np.searchsorted(passed[1:-1], cut, side="right").tolist()
        if first == last:
            continue
        leave, join = (
            corners[k] + (at - passed[k]) / lengths[k] * (corners[k + 1] - corners[k])
            for k, at in zip((first, last), cut, strict=True)
        )
        shorter = [*corners[: first + 1], leave, join, *corners[last + 1 :]]
        # The shortcut itself is the least likely to be clear.
        if all(space.keeps_margin(shorter, first + k, first + k + 1) for k in (1, 0, 2)):
            corners = shorter
    return np.array(_without_detours(corners, space))


def _without_detours(corners: list[Array], space: _Space) -> list[Array]:
    """Leave out corners between two others with a clear straight path between them."""
    last, kept, here = len(corners) - 1, [corners[0]], 0
    while here < last:
        here = next((k for k in range(last, here + 1, -1) if space.keeps_margin(corners, here, k)), here + 1)
        kept.append(corners[here])
    return kept
