"""Episodes to learn from: what was seen, and what the expert would have done."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_ur10.policies.training.expert import Expert
from dual_ur10.types import Array, Single

# Of the noise, from one step to the next, drawn for each episode. What drifts leads to where a pupil errs to; what
# shakes tells commanded from measured positions.
_MEMORY: Final = (0.5, 0.95)
_HELP: Final = (10, 40)  # steps for which the expert drives then
_FAST: Final = 0.5  # share of the speed limit below which the noise is less
_SWELL: Final = (50, 200)  # steps in which the noise swells and ebbs, drawn for each episode


class Gathered(NamedTuple):
    """What was seen in some episodes.

    Attributes:
        observation: (k, O) as observed.
        action: (k, A) the expert's.
        returns: (e,) of the episodes that the learner drove from the beginning; of all, if there are none.
        successes: (e,) of the same; none with the expert's help.
        steps: Steps of the environment in all.
        longest: Steps of the longest episode.
    """

    observation: Single
    action: Single
    returns: Array
    successes: NDArray[np.bool_]
    steps: int
    longest: int


def gather(
    env: Any,
    expert: Expert,
    learner: Callable[[Array], Any] | None,
    seeds: Sequence[int],
    *,
    share: float,
    within: int,
    noise: float,
    patience: float,
    rng: np.random.Generator,
    on_step: Callable[[int], None] = lambda steps: None,
) -> Gathered:
    """Run an episode in every row, and begin no other.

    The expert drives a share of the rows up to a step that is drawn for each, and the learner from there on: so it is
    seen everywhere, also where it would not get by itself. And where the learner wants something quite different from
    what the expert would do, the expert drives for a while and brings it back: else most rows would end early, and all
    be about the same mistakes (HG-DAgger: M. Kelly et al., ICRA 2019).

    Args:
        env: A `dual_ur10.envs.api.vector_env.DualArmVectorEnv` that resets nothing by itself.
        expert: With as many rows.
        learner: None: the expert drives all rows to the end.
        seeds: Of the rows.
        share: Probability that the expert begins a row.
        within: Steps, uniformly within which it hands over there.
        noise: Largest standard deviation of what is added to its actions.
        patience: Largest difference of any joint's action from the expert's at which the learner drives on.
        rng: Draws who drives, and the noise.
        on_step: Told of the number of steps whenever all rows have moved.
    """
    n, core = env.num_envs, env.unwrapped.core
    low, high = core.action_space.low, core.action_space.high
    joints = np.ones(len(low), dtype=np.float32)
    if core.pipeline.adapter.gripper:
        joints.reshape(2, -1)[:, -1] = 0.0  # fingers that shake let go
    # The step at which the learner takes over.
    handed = np.where(rng.random(n) < share, rng.integers(1, within + 1, n), 0)
    if learner is None:
        handed[:] = np.iinfo(handed.dtype).max
    scale = (noise * rng.random((n, 1))).astype(np.float32) * joints
    added = np.zeros((n, len(low)), dtype=np.float32)
    memory = rng.uniform(*_MEMORY, (n, 1)).astype(np.float32)
    swell, phase = rng.uniform(*_SWELL, (n, 1)), rng.uniform(0, 2 * np.pi, (n, 1))
    observation, _ = env.reset(seed=list(seeds))
    for row in range(n):
        expert.begin(row)
    live, alone, helped = np.ones(n, dtype=bool), handed == 0, np.zeros(n, dtype=int)
    seen: list[Single] = []
    said: list[Single] = []
    returns, successes, steps, now = np.zeros(n), np.zeros(n, dtype=bool), 0, 0
    while live.any():
        wanted, keep = expert(observation, live)
        seen.append(observation[keep].astype(np.float32))
        said.append(wanted[keep])
        fresh = scale * rng.standard_normal(added.shape, dtype=np.float32)
        added = memory * added + np.sqrt(1 - memory**2) * fresh
        # Where the expert slows down, beside a table or another hand, there is no room for it.
        speed = np.abs(wanted * joints).max(axis=1, keepdims=True)
        loud = np.minimum(1.0, speed / _FAST) * np.maximum(0.0, np.sin(2 * np.pi * now / swell + phase))
        action = wanted + loud.astype(np.float32) * added
        own = (handed <= now) & (helped <= now)
        if learner is not None and own.any():
            wish = np.asarray(learner(observation))
            apart = np.abs((np.clip(wish, low, high) - wanted) * joints).max(axis=1)
            lost = own & live & (apart > patience)
            helped[lost] = now + rng.integers(*_HELP, int(lost.sum()))
            alone &= ~lost
            own &= ~lost
            action[own] = wish[own]
        observation, reward, terminated, truncated, info = env.step(np.clip(action, low, high))
        steps, now = steps + int(live.sum()), now + 1
        returns[live] += reward[live]
        over = terminated | truncated
        successes |= live & over & np.asarray(info["is_success"], dtype=bool)
        live &= ~over
        on_step(steps)
        if over.any() and live.any():
            # Nothing is learned from these rows any more; the environment wants them to begin anew.
            observation, _ = env.reset(options={"reset_mask": over})
    judged = handed == 0 if (handed == 0).any() else np.ones(n, dtype=bool)
    if learner is not None:
        successes &= alone
    return Gathered(np.concatenate(seen), np.concatenate(said), returns[judged], successes[judged], steps, now)
