"""Rollout of a policy: one episode and its measurements."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dual_ur10.envs.core.ends import early_end
from dual_ur10.envs.core.options import MOVE_TO_START
from dual_ur10.errors import SettingsError
from dual_ur10.policies.policy import Commanded, Policy, TimeAware, as_policy
from dual_ur10.policies.registry import executed
from ur_core.kinematics.frames import ArmMount
from ur_core.types import Array

Info = Mapping[str, Any]


@dataclass(frozen=True)
class Record:
    """Measurements of one episode. Row k of an array is the end of step k; the reset is not included.

    Attributes:
        period_s: Time between two rows.
        mounts: Base poses and kinematics of both arms.
        q_rad: (k, 2, 6) joint positions.
        flange_m: (k, 2, 3) flange positions in the cell frame, as the cell reports them.
        reward: (k,).
        success: True if the task reports success.
        ended_by: Reason of an early end, such as the gate's verdict or "bar_lost"; "" if there was none.
        end_reason: Name of the end, as `info["end_reason"]` has it.
        reference_m: (k, 2, 3) reference positions of the flanges; None if the task has none.
        flange_error_m: (k, 2) distance of each flange to its reference, as the task reports it; None as above.
        orientation_error_rad: (k, 2) angle of each flange to its reference orientation; None as above.
    """

    period_s: float
    mounts: tuple[ArmMount, ArmMount]
    q_rad: Array
    flange_m: Array
    reward: Array
    success: bool
    ended_by: str = ""
    end_reason: str = ""
    reference_m: Array | None = None
    flange_error_m: Array | None = None
    orientation_error_rad: Array | None = None

    def __repr__(self) -> str:
        end = f", ended by {self.ended_by}" if self.ended_by else ""
        success = "success" if self.success else "no success"
        return f"{type(self).__name__}({self.steps} steps, return {self.reward.sum():.6g}, {success}{end})"

    @property
    def steps(self) -> int:
        """Number of rows."""
        return len(self.reward)

    @property
    def time_s(self) -> Array:
        """(k,) time since the reset."""
        time_s: Array = self.period_s * np.arange(1, self.steps + 1, dtype=np.float64)
        return time_s


class Trace:
    """Recorder of `info` over one episode, for `on_step` of `rollout`. Rows are as in `Record`."""

    def __init__(self) -> None:
        self._rows: list[dict[str, Any]] = []

    def __call__(self, info: Info) -> None:
        """Append the info of one step."""
        self._rows.append(dict(info))

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, name: str) -> Array:
        """Return a value over time, (k, ...)."""
        return np.array([row[name] for row in self._rows], dtype=np.float64)


def offer_time(policy: Policy, env: Any) -> None:
    """Give a policy the time of the last observation, if it takes it.

    Args:
        policy: The policy.
        env: Environment in which it acts.
    """
    if isinstance(policy, TimeAware):
        policy.observed_at(env.unwrapped.core.time_s)


def act(policy: Policy, observation: Any, env: Any, dtype: Any) -> Array:
    """Return the action of a policy, which is offered the time of the observation. If it fails, moving arms stop.

    The environment is given who commands.

    Args:
        policy: The policy.
        observation: For the policy.
        env: Environment in which it acts.
        dtype: Type of the action's numbers.

    Raises:
        Exception: As raised by the policy. Arms that are not simulated then have a latched stop, and a note, which ends
            the traceback, names the cause and what to do.
    """
    try:
        offer_time(policy, env)
        action = np.asarray(policy(observation), dtype=dtype)
        nobody = np.zeros(2, dtype=bool)
        env.unwrapped.core.commander = policy.commander if isinstance(policy, Commanded) else nobody
        return action
    except Exception as error:
        # Real arms must not keep moving without a policy.
        text = env.unwrapped.core.stop(f"the policy failed: {type(error).__name__}: {error}")
        if text:
            error.add_note(text)
        raise


def rollout(
    env: Any,
    policy: Policy | Callable[[Any], Any],
    *,
    seed: int | None = None,
    on_step: Callable[[Info], None] | None = None,
) -> Record:
    """Run one episode. On a cell of two controllers this moves both arms to where it begins.

    Args:
        env: Environment made by `gym.make`.
        policy: Policy, which is reset first; a chunk policy; or a plain function of the observation.
        seed: Seed of the environment's reset.
        on_step: Callback with `info` after every step.

    Raises:
        PolicyError: The policy is neither.
        SettingsError: The environment is none.
        DualUR10Error: The environment failed.
        Exception: As raised by the policy, see `act`.
    """
    if hasattr(env, "unwrapped"):
        policy = executed(policy, lambda: env.unwrapped.core.setup)
    policy = as_policy(policy)
    if not hasattr(env, "unwrapped"):
        raise SettingsError(
            f"the environment is {env!r:.80}: pass one that gym.make has made, or both results of make(policy, id)"
        )
    observation, _ = env.reset(seed=seed, options={MOVE_TO_START: True})
    policy.reset()
    kind = env.action_space.dtype
    rewards: list[float] = []
    kept: dict[str, list[Any]] = {name: [] for name in _KEPT}
    over, info = False, {}
    while not over:
        action = act(policy, observation, env, kind)
        observation, reward, terminated, truncated, info = env.step(action)
        rewards.append(float(reward))
        for name, rows in kept.items():
            if name in info:
                rows.append(np.array(info[name], dtype=np.float64))
        if on_step is not None:
            on_step(info)
        over = terminated or truncated
    core = env.unwrapped.core
    arrays = {name: np.array(rows) if rows else None for name, rows in kept.items()}
    return Record(
        period_s=core.timing.period_s,
        mounts=(core.config.left, core.config.right),
        reward=np.array(rewards),
        success=bool(info.get("is_success", False)),
        ended_by=early_end(info),
        end_reason=str(info.get("end_reason", "")),
        **arrays,  # type: ignore[arg-type]  # the keys are the fields
    )


_KEPT = ("q_rad", "flange_m", "reference_m", "flange_error_m", "orientation_error_rad")
