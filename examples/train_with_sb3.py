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
from stable_baselines3.common.noise import NormalActionNoise

from dual_ur10.envs.api.sb3_bridge import CellsVecEnv, JointVecEnv, TwoAgentVecEnv
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.from_sb3 import converted

SEEN: dict[str, Any] = {"observation": "goals", "action_scale": 0.5}
SHORT = 100  # steps of an episode: an untrained policy is back at the reference before it has drifted far
CELLS = {"PPO": 64, "SAC": 8, "TD3": 8}
ARM = 6  # actions
SETTINGS: dict[str, dict[str, Any]] = {
    "PPO": {
        "learning_rate": lambda left: 1e-3 * left,
        "gamma": 0.9,
        "n_steps": 16,
        "batch_size": 256,
        "policy_kwargs": {"log_std_init": -2.0},
    },
    # Each of these is one policy for either arm. Its value function learns from the reward of that arm alone.
    "SAC": {
        "learning_rate": 1e-3,
        "gamma": 0.9,
        "gradient_steps": 8,
        "learning_starts": 10_000,
        "ent_coef": "auto_0.01",
        "policy_kwargs": {"net_arch": [64, 64]},
    },
    "TD3": {
        "learning_rate": lambda left: 1e-3 * left,
        "gamma": 0.9,
        "gradient_steps": 8,
        "learning_starts": 10_000,
        "action_noise": NormalActionNoise(np.zeros(ARM), np.full(ARM, 0.05)),
        # Noise of 0.2, the default, is an error of 21 mm.
        "target_policy_noise": 0.02,
        "target_noise_clip": 0.05,
        "policy_kwargs": {"net_arch": [64, 64]},
    },
}
STEPS = {"PPO": 600_000, "SAC": 60_000, "TD3": 60_000}


def cells(algorithm: str, number: int, reward: str = "individual", **keywords: Any) -> CellsVecEnv:
    """Return cells in one batch: a row for each, or one for each arm."""
    if algorithm == "PPO":
        return JointVecEnv("SineTracking", number, **SEEN, **keywords)
    return TwoAgentVecEnv("SineTracking", number, reward=reward, **SEEN, **keywords)


def measure(algorithm: str, model: BaseAlgorithm, episodes: int, first_seed: int) -> dict[str, float]:
    """Return means of whole episodes without exploration: return, flange error in mm, and success."""
    env = cells(algorithm, episodes, reward="shared")
    env.seed(first_seed)
    observation, live = env.reset(), np.ones(env.num_envs, dtype=bool)
    steps, earned, error_mm, success = np.zeros((4, env.num_envs))
    while live.any():
        observation, reward, over, infos = env.step(model.predict(observation, deterministic=True)[0])
        steps += live
        earned += live * reward
        error_mm += live * [1e3 * np.mean(info["flange_error_m"]) for info in infos]
        success += live & over & [bool(info.get("is_success")) for info in infos]
        live &= ~over
    env.close()
    return {"return": earned.mean(), "error_mm": (error_mm / steps).mean(), "success": success.mean()}


def train(
    algorithm: str, seed: int, steps: int = 0, settings: dict[str, Any] | None = None, number: int = 0
) -> tuple[BaseAlgorithm, float]:
    """Train, print the curve, and return the model and the minutes without those of the checks."""
    torch.set_num_threads(1)  # the cells use the others
    number, steps = number or CELLS[algorithm], steps or STEPS[algorithm]
    env = cells(algorithm, number, max_episode_steps=SHORT)
    rows = env.num_envs // number
    chosen = SETTINGS[algorithm] if settings is None else settings
    # It learns from episodes with this seed and those that follow.
    first_seed = 1_000_000_000 + 1_000_000 * seed
    model = getattr(stable_baselines3, algorithm)("MlpPolicy", env, seed=first_seed, device="cpu", **chosen)
    begin_s, checked_s = time.monotonic(), 0.0

    def check(*_: object) -> bool:
        nonlocal checked_s
        now_s = time.monotonic()
        found = measure(algorithm, model, 8, 10_000_000)
        minutes = (now_s - begin_s - checked_s) / 60
        print(
            f"{model.num_timesteps // rows:9} steps, {minutes:5.1f} min: return {found['return']:6.1f}, flange error "
            f"{found['error_mm']:5.1f} mm, success {100 * found['success']:3.0f} %",
            flush=True,
        )
        checked_s += time.monotonic() - now_s
        return True

    # It counts rows.
    model.learn(rows * steps, callback=EveryNTimesteps(rows * max(10_000, steps // 10), ConvertCallback(check)))
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
        agents = "joint" if algorithm == "PPO" else "shared"
        checkpoint.save(folder, *converted(model, "DualUR10/SineTracking-v0", agents=agents, **SEEN))
