"""Policies, and where to find them by name, or by the path of a checkpoint."""

from __future__ import annotations

import dataclasses
import importlib
import os
from typing import Any

from dual_ur10.envs.core.core import load_task
from dual_ur10.envs.core.options import split_keywords
from dual_ur10.envs.core.randomization import resolve_randomization
from dual_ur10.envs.tasks.task import Timing, task_settings
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.ids import ENV_IDS, env_id_of, task_name
from dual_ur10.policies.learned import shipped
from dual_ur10.policies.policy import Policy
from dual_ur10.sim2real.config.cell import resolve_cell

NAMES = ("scripted", *shipped.NAMES)
"""Policies that are loaded by name. Not every task has every one of them."""

_SCRIPTED = {
    "SineTracking": "sine_tracking:SineTrackingPolicy",
    "SyncCarry": "sync_carry:SyncCarryPolicy",
    "Handover": "handover:HandoverPolicy",
}

__all__ = ["NAMES", "Policy", "is_path", "load"]


def is_path(name: object) -> bool:
    """Whether `load` takes this for the path of a checkpoint, not for a name. A name is no path."""
    if not isinstance(name, str):
        return isinstance(name, os.PathLike)
    return name not in NAMES and "\0" not in name and (os.sep in name or os.path.lexists(name))


def load(name: str | os.PathLike[str], env_id: str | None = None, **keywords: Any) -> Policy:
    """A policy by name, for an environment made with these keywords; or that of a checkpoint, checked against it.

    A scripted policy is told of the rate and latency of actions, of where the arms stand and how fast they may move,
    and of the task's settings. It is not told what kind of cell it moves.

    Args:
        name: One of `NAMES`, or the path of a checkpoint's folder, with a "/" in it if there is no such folder.
        env_id: Id of the environment. None: that of the checkpoint, which a name does not have.
        **keywords: As given to `gym.make`. Those that concern neither task nor cell do not matter to a policy. With
            neither `env_id` nor keywords, those of the checkpoint.

    Raises:
        UnknownNameError: No such policy, or no such environment.
        SettingsError: A name is given, and no environment.
        CheckpointError: The checkpoint cannot be read, or was made for another environment.
    """
    if name in shipped.NAMES and env_id is not None:
        name = shipped.folder_of(str(name), env_id)
    if is_path(name):
        from dual_ur10.policies.learned.checkpoint import load as load_checkpoint

        return load_checkpoint(name, env_id, **keywords)
    if name not in NAMES:
        raise UnknownNameError("policy", str(name), [*NAMES, "the path of a checkpoint"])
    if env_id is None:
        raise SettingsError(
            f"policy {str(name)!r} needs an environment: name one of {', '.join(ENV_IDS)}; only the path of a "
            "checkpoint does without"
        )
    task = load_task(task_name(env_id_of(env_id)))
    options, own = split_keywords(keywords)
    config = resolve_cell(options.cell)
    period_s = config.servoj.ticks_per_action(options.policy_rate_hz) * config.servoj.tick_s
    timing = Timing(period_s, period_s + options.latency_ticks(config) * config.servoj.tick_s)
    own = {key: own[key] for key in own if key in {each.name for each in dataclasses.fields(task.settings_type)}}
    settings = resolve_randomization(options.randomization).spread(task_settings(task, own), own)
    module, attribute = _SCRIPTED[task.name].split(":")
    factory = getattr(importlib.import_module(f"dual_ur10.policies.scripted.{module}"), attribute)
    mounts, limits = (config.left, config.right), config.capped(task.limits)
    policy: Policy = factory(timing, options.action_mode, mounts=mounts, limits=limits, settings=settings)
    return policy
