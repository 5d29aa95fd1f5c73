"""A recorded run of two short episodes, and a dataset of it."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.lerobot.lerobot_export import runs_of, to_lerobot
from ur_core.kinematics.ur10 import ARMS

STEPS = (9, 5)


def recorded(folder, env_id="DualUR10/Handover-v0", steps=STEPS, *, commander=(False, True), **keywords):
    """Record episodes of random actions; return the commanded joints, (m, 2, 6), after each step."""
    env = gym.make(f"dual_ur10:{env_id}", record=str(folder), randomization="mild", on_refusal="brake", **keywords)
    rng, commanded = np.random.default_rng(0), []
    for number, count in enumerate(steps):
        env.reset(seed=7 + number)
        rows = []
        for _ in range(count):
            env.unwrapped.core.commander = np.array(commander)
            env.step(rng.uniform(-0.3, 0.3, env.action_space.shape).astype(np.float32))
            rows.append(env.unwrapped.core.pipeline.adapter.commanded_q_rad[0])
        commanded.append(np.array(rows))
    env.close()
    return commanded


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """Folder of runs, folder of their dataset, and the commanded joints of each episode."""
    root = tmp_path_factory.mktemp("lerobot")
    commanded = recorded(root / "runs")
    to_lerobot(runs_of([root / "runs"]), root / "dataset")
    return root / "runs", root / "dataset", commanded


def foreign(writer, folder, motion, *, fps=30, names=None, degrees=False):
    """Write a dataset of other people's arms, whose action is a motion, (frames, joints), of each episode."""
    from dual_ur10.lerobot.features import DatasetFeature

    size = motion[0].shape[1]
    names = names or tuple(f"{arm}_joint_{k}" for arm in ARMS for k in range(1, 7))[:size]
    with writer(folder, fps, {"action": DatasetFeature("float32", (size,), names)}, "ur5e") as made:
        for each in motion:
            made.add({"action": (np.degrees(each) if degrees else each).astype(np.float32)}, "pick")
