"""Simulated episodes, recorded as they are when a user records them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10 import policies
from dual_ur10.sim2real.recording.header import describe
from dual_ur10.sim2real.recording.hook import RecordHook
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.run import Run
from dual_ur10.sim2real.recording.simulation import SimulationRecord


def record(folder: Path, env_id: str, seeds: Sequence[int | None], steps: int, **keywords: Any) -> Run:
    """Episodes of the scripted policy, of at most `steps` steps each, written and read."""
    env: Any = gym.make(env_id, **keywords)
    policy, core = policies.load("scripted", env_id, **keywords), env.unwrapped.core
    latency = core.options.latency_ticks(core.config)
    described = {name: value for name, value in keywords.items() if name != "confirm"}
    header = describe(
        env_id,
        described,
        core.config,
        period_ticks=core.pipeline.adapter.ticks,
        latency_ticks=latency,
        seed=seeds[0],
        policy="scripted",
    )
    folder.mkdir()
    writer = SimulationRecord(folder, header)
    core.attach(RecordHook(writer, core.cell))
    try:
        for seed in seeds:
            observation, _ = env.reset(seed=seed)
            policy.reset()
            for _ in range(steps):
                action = np.asarray(policy(observation), dtype=env.action_space.dtype)
                observation, _, terminated, truncated, _ = env.step(action)
                if terminated or truncated:
                    break
    finally:
        env.close()
        writer.close()
    return read_run(folder)
