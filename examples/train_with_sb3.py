"""Stock Stable-Baselines3, from scratch: python examples/train_with_sb3.py [PPO|SAC|TD3] [STEPS] [FOLDER] [SEED].

It prints the curve of its training: what the policy does without exploration, in whole episodes that it does not learn
from. The result is a checkpoint, with PPO and SAC:

python -m dual_ur10 evaluate SineTracking --policy FOLDER --set observation=goals --set action_scale=0.5
"""

import sys
import time
from typing import Any

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import ConvertCallback, EveryNTimesteps

from dual_ur10.envs.api.sb3_bridge import JointVecEnv
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.from_sb3 import converted

SEEN: dict[str, Any] = {"observation": "goals", "action_scale": 0.5}
SHORT = 100  # steps of an episode: an untrained policy is back at the reference before it has drifted far
CELLS = {"PPO": 64, "SAC": 16, "TD3": 16}
SETTINGS: dict[str, dict[str, Any]] = {
    "PPO": {
        "learning_rate": lambda left: 1e-3 * left,
        "gamma": 0.9,
        "n_steps": 16,
        "batch_size": 256,
        "policy_kwargs": {"log_std_init": -2.0},
    },
    "SAC": {"learning_rate": 1e-3, "gamma": 0.9, "gradient_steps": 4, "ent_coef": 0.01},
    "TD3": {"learning_rate": 1e-3, "gamma": 0.9, "gradient_steps": 4},
}
STEPS = {"PPO": 600_000, "SAC": 100_000, "TD3": 100_000}


def measure(model: BaseAlgorithm, episodes: int, first_seed: int) -> dict[str, float]:
    """Return means of whole episodes without exploration: return, flange error in mm, and success."""
    env = JointVecEnv("SineTracking", episodes, **SEEN)
    env.seed(first_seed)
    observation, live = env.reset(), np.ones(episodes, dtype=bool)
    steps, earned, error_mm, success = np.zeros((4, episodes))
    while live.any():
        observation, reward, over, infos = env.step(model.predict(observation, deterministic=True)[0])
        steps += live
        earned += live * reward
        error_mm += live * [1e3 * np.mean(info["flange_error_m"]) for info in infos]
        success += live & over & [info.get("is_success", False) for info in infos]
        live &= ~over
    env.close()
    return {"return": earned.mean(), "error_mm": (error_mm / steps).mean(), "success": success.mean()}


def train(
    algorithm: str, seed: int, steps: int = 0, settings: dict[str, Any] | None = None, cells: int = 0
) -> tuple[BaseAlgorithm, float]:
    """Train, print the curve, and return the model and the minutes without those of the checks."""
    torch.set_num_threads(1)  # the cells use the others
    env = JointVecEnv("SineTracking", cells or CELLS[algorithm], max_episode_steps=SHORT, **SEEN)
    steps, chosen = steps or STEPS[algorithm], SETTINGS[algorithm] if settings is None else settings
    # It learns from episodes with this seed and those that follow.
    first_seed = 1_000_000_000 + 1_000_000 * seed
    model = getattr(stable_baselines3, algorithm)("MlpPolicy", env, seed=first_seed, device="cpu", **chosen)
    begin_s, checked_s = time.monotonic(), 0.0

    def check(*_: object) -> bool:
        nonlocal checked_s
        now_s = time.monotonic()
        found = measure(model, 8, 10_000_000)
        minutes = (now_s - begin_s - checked_s) / 60
        print(
            f"{model.num_timesteps:9} steps, {minutes:5.1f} min: return {found['return']:6.1f}, flange error "
            f"{found['error_mm']:5.1f} mm, success {100 * found['success']:3.0f} %",
            flush=True,
        )
        checked_s += time.monotonic() - now_s
        return True

    model.learn(steps, callback=EveryNTimesteps(max(10_000, steps // 10), ConvertCallback(check)))
    minutes = (time.monotonic() - begin_s - checked_s) / 60
    env.close()
    return model, minutes


if __name__ == "__main__":
    algorithm = sys.argv[1] if len(sys.argv) > 1 else "PPO"
    steps = int(sys.argv[2]) if len(sys.argv) > 2 else STEPS[algorithm]
    seed = int(sys.argv[4]) if len(sys.argv) > 4 else 0
    folder = checkpoint.check_new(sys.argv[3] if len(sys.argv) > 3 else f"sine_{algorithm.lower()}")
    model, minutes = train(algorithm, seed, steps)
    print(f"{minutes:.1f} min without the checks")
    if algorithm == "TD3":
        model.save(folder)  # a pickle: read only your own
    else:  # a checkpoint holds numbers and text only, is checked against its environment, and runs without torch
        checkpoint.save(folder, *converted(model, "DualUR10/SineTracking-v0", **SEEN))
