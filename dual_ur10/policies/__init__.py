"""Policies, and where to find them by name."""

from __future__ import annotations

from typing import Any

from dual_ur10.envs.core import DEFAULT_RATE_HZ, load_task
from dual_ur10.envs.task import Timing
from dual_ur10.errors import UnknownNameError
from dual_ur10.policies.policy import Policy
from dual_ur10.policies.sine_tracking import SineTrackingPolicy
from dual_ur10.sim2real.cell import resolve_cell

NAMES = ("scripted",)

_SCRIPTED = {"SineTracking": SineTrackingPolicy}

__all__ = ["NAMES", "Policy", "SineTrackingPolicy", "load"]


def load(
    name: str,
    env_id: str,
    *,
    cell: object = "mujoco",
    policy_rate_hz: float = DEFAULT_RATE_HZ,
    action_mode: str = "joint_delta",
    action_latency_ticks: int = 0,
    **_: Any,
) -> Policy:
    """A policy by name, for an environment made with these keywords.

    Args:
        name: "scripted".
        env_id: Id of the environment.
        cell: As given to `gym.make`, like all that follow.
        policy_rate_hz: Actions per second.
        action_mode: What an action means.
        action_latency_ticks: Ticks from an observation to the first target of its action.
        **_: Other keywords of the environment do not matter to a policy and may be passed on as they are.

    Raises:
        UnknownNameError: No such policy, or no such task.
    """
    if name not in NAMES:
        raise UnknownNameError("policy", str(name), NAMES)
    task = load_task(env_id.split("/")[-1].rsplit("-v", 1)[0])
    config = resolve_cell(cell)
    period_s = config.servoj.ticks_per_action(policy_rate_hz) * config.servoj.tick_s
    timing = Timing(period_s, period_s + action_latency_ticks * config.servoj.tick_s)
    return _SCRIPTED[task.name](timing, action_mode, [config.left.dh, config.right.dh])
