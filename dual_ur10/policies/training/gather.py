"""Samples for imitation: observations of driven episodes, and the expert's action for each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_ur10 import policies
from dual_ur10.errors import DualUR10Error
from dual_ur10.policies.policy import Policy, Teaching
from ur_core.types import Array, Mask, Single

# Correlation of the noise from step to step, sampled for each episode. Slow noise leads to where a learner errs to;
# fast noise separates commanded from measured positions.
_MEMORY: Final = (0.5, 0.95)
_HELP: Final = (10, 40)  # steps for which the expert then drives
_FAST: Final = 0.5  # ratio of the speed limit below which the noise is reduced
_SWELL: Final = (50, 200)  # period of the noise's amplitude in steps, sampled for each episode


class Expert:
    """Scripted policy for each row, so that a row in which it fails does not disturb the others.

    Args:
        env_id: Id of the environment.
        rows: Number of rows.
        low, high: (size,) bounds of an action.
        **keywords: Keywords of the environment.
    """

    def __init__(self, env_id: str, rows: int, low: Single, high: Single, **keywords: Any) -> None:
        if keywords.get("observation") == "both":
            keywords = {**keywords, "observation": "state"}  # the numbers beside the images
        self._policies: list[Policy] = [policies.load("scripted", env_id, **keywords) for _ in range(rows)]
        for each in self._policies:
            if isinstance(each, Teaching):
                each.teach()
        self._low, self._high = low, high
        self._lost = np.zeros(rows, dtype=bool)

    def begin(self, row: int) -> None:
        """Begin an episode in a row."""
        self._policies[row].reset()
        self._lost[row] = False

    def __call__(self, observation: Array, live: Mask) -> tuple[Single, Mask]:
        """Return its actions, (n, size), for observations, (n, ...), and the live rows in which it has one, (n,).

        A row in which it fails once, for example because the object has fallen out of reach, has no action until its
        next episode: a script's later actions are meaningless.
        """
        action = np.zeros((len(observation), len(self._low)), dtype=np.float32)
        for row in np.flatnonzero(live & ~self._lost).tolist():
            try:
                action[row] = self._policies[row](observation[row])
            except DualUR10Error:
                self._lost[row] = True
        self._lost |= ~np.isfinite(action).all(axis=1)
        action[self._lost] = 0.0
        return np.clip(action, self._low, self._high), live & ~self._lost


class Samples(NamedTuple):
    """Samples of some episodes.

    Attributes:
        observation: (k, O) observations.
        action: (k, A) actions of the expert.
        episode: (k,) number of the episode that each sample is of. Those of an episode are in order.
        images: (k, cameras, height, width, 3) observed images; None: there are none.
    """

    observation: Single
    action: Single
    episode: NDArray[np.int64]
    images: NDArray[np.uint8] | None = None


class Gathered(NamedTuple):
    """Samples of some episodes, and how they went.

    Attributes:
        observation: (k, O) observations.
        action: (k, A) actions of the expert.
        episode: (k,) row of the episode that each is of. Those of an episode are in order.
        returns: (e,) returns of the episodes that the learner drove from the beginning; of all, if there are none.
        successes: (e,) successes of the same; False where the expert helped.
        steps: Total number of environment steps.
        longest: Steps of the longest episode.
        images: (k, cameras, height, width, 3) observed images; None: there are none.
    """

    observation: Single
    action: Single
    episode: NDArray[np.int64]
    returns: Array
    successes: NDArray[np.bool_]
    steps: int
    longest: int
    images: NDArray[np.uint8] | None = None


class _Noise:
    """Noise on an expert's actions, which every row samples in a way of its own.

    Args:
        rows: Number of rows.
        joints: (size,) 1 where an action is a joint's, 0 elsewhere.
        largest: Largest standard deviation.
        rng: Generator.
    """

    def __init__(self, rows: int, joints: Single, largest: float, rng: np.random.Generator) -> None:
        self._joints, self._rng = joints, rng
        self._scale = (largest * rng.random((rows, 1))).astype(np.float32) * joints
        self._added = np.zeros((rows, len(joints)), dtype=np.float32)
        self._memory = rng.uniform(*_MEMORY, (rows, 1)).astype(np.float32)
        self._swell, self._phase = rng.uniform(*_SWELL, (rows, 1)), rng.uniform(0, 2 * np.pi, (rows, 1))

    def __call__(self, wanted: Single, step: int) -> Single:
        """Return actions, (rows, size), with the noise of one step."""
        fresh = self._scale * self._rng.standard_normal(self._added.shape, dtype=np.float32)
        self._added = self._memory * self._added + np.sqrt(1 - self._memory**2) * fresh
        # Where the expert slows down, beside a table or another gripper, there is no room for noise.
        speed = np.abs(wanted * self._joints).max(axis=1, keepdims=True)
        swelling = np.maximum(0.0, np.sin(2 * np.pi * step / self._swell + self._phase))
        loud = np.minimum(1.0, speed / _FAST) * swelling
        shaken: Single = wanted + loud.astype(np.float32) * self._added
        return shaken


def gather(
    env: Any,
    expert: Expert,
    learner: Callable[[Array], Any] | None,
    seeds: Sequence[int],
    *,
    expert_ratio: float,
    within: int,
    noise: float,
    patience: float,
    rng: np.random.Generator,
    rows: int | None = None,
    on_step: Callable[[int], None] = lambda steps: None,
) -> Gathered:
    """Run one episode in every row, or in the first rows alone.

    In a random part of the rows the expert drives up to a random step, and the learner from there on, so that the
    samples include states that the learner would not reach by itself. If the learner's action differs too much from
    the expert's, the expert drives for a while and recovers: otherwise most rows would end early, all by the same
    mistakes (HG-DAgger: M. Kelly et al., ICRA 2019).

    Args:
        env: A `dual_ur10.envs.api.vector_env.DualArmVectorEnv` without automatic resets.
        expert: Expert with as many rows.
        learner: Policy that takes batches; None: the expert drives all rows to the end.
        seeds: Seeds of the rows.
        expert_ratio: Probability that the expert begins a row.
        within: Number of steps within which it hands over, uniformly sampled.
        noise: Largest standard deviation of the noise on its actions.
        patience: Largest difference of any joint's action from the expert's at which the learner keeps driving.
        rng: Generator of all random choices and the noise.
        rows: Number of rows that count; the others idle. None: all.
        on_step: Callback with the number of steps so far.
    """
    n, core = env.num_envs, env.unwrapped.core
    cameras = core.options.camera_names if core.options.pictured else ()
    low, high = core.action_space.low, core.action_space.high
    joints = np.ones(len(low), dtype=np.float32)
    if core.pipeline.adapter.gripper:
        joints.reshape(2, -1)[:, -1] = 0.0  # shaking fingers lose the object
    # The step at which the learner takes over.
    handed = np.where(rng.random(n) < expert_ratio, rng.integers(1, within + 1, n), 0)
    if learner is None:
        handed[:] = np.iinfo(handed.dtype).max
    shaken = _Noise(n, joints, noise, rng)
    observation, _ = env.reset(seed=list(seeds))
    for row in range(n):
        expert.begin(row)
    counted = np.arange(n) < (n if rows is None else rows)
    live, alone, helped = counted.copy(), handed == 0, np.zeros(n, dtype=int)
    seen, labels, numbers = list[Single](), list[Single](), list[NDArray[np.int64]]()
    pictures = list[NDArray[np.uint8]]()
    returns, successes, steps, now = np.zeros(n), np.zeros(n, dtype=bool), 0, 0
    while live.any():
        fields = observation["state"] if cameras else observation
        wanted, keep = expert(fields, live)
        seen.append(fields[keep].astype(np.float32))
        if cameras:
            pictures.append(np.stack([observation["pixels"][each][keep] for each in cameras], axis=1))
        labels.append(wanted[keep])
        numbers.append(np.flatnonzero(keep))
        action = shaken(wanted, now)
        own = (handed <= now) & (helped <= now)
        if learner is not None and own.any():
            proposed = np.asarray(learner(observation))
            difference = np.abs((np.clip(proposed, low, high) - wanted) * joints).max(axis=1)
            lost = own & live & (difference > patience)
            helped[lost] = now + rng.integers(*_HELP, int(lost.sum()))
            alone &= ~lost
            own &= ~lost
            action[own] = proposed[own]
        observation, reward, terminated, truncated, info = env.step(np.clip(action, low, high))
        steps, now = steps + int(live.sum()), now + 1
        returns[live] += reward[live]
        over = terminated | truncated
        successes |= live & over & np.asarray(info["is_success"], dtype=bool)
        live &= ~over
        on_step(steps)
        if over.any() and live.any():
            # These rows are done, but the environment must not step rows whose episode is over.
            observation, _ = env.reset(options={"reset_mask": over})
    judged = counted & (handed == 0)
    judged = judged if judged.any() else counted
    if learner is not None:
        successes &= alone
    return Gathered(
        np.concatenate(seen),
        np.concatenate(labels),
        np.concatenate(numbers),
        returns[judged],
        successes[judged],
        steps,
        now,
        np.concatenate(pictures) if pictures else None,
    )
