"""Stock Stable-Baselines3, from scratch: python examples/train_with_sb3.py [PPO|SAC|TD3] [--task Handover] [--lift].

It prints the curve of its training: what the policy does without exploration, in whole episodes that it does not learn
from. The result is a checkpoint, with PPO and SAC; the last line that it prints is the
command that evaluates it.
"""

import argparse
import json
import math
import time
from collections.abc import Iterable
from typing import Any

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import ConvertCallback, EveryNTimesteps
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from dual_ur10.envs.api.sb3_bridge import CellsVecEnv, JointVecEnv, RewardDifferences, TwoAgentVecEnv, hide
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.from_sb3 import converted

SINE = "SineTracking"
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

# PPO on the tasks with objects: one policy for either arm, steps of the tools, wider exploration.
OBJECTS: dict[str, Any] = {"observation": "goals", "action_mode": "tcp_delta"}
OBJECTS_SETTINGS: dict[str, Any] = {
    "learning_rate": lambda left: 5e-4 * left,
    "gamma": 0.95,
    "n_steps": 32,
    "batch_size": 1024,
    "policy_kwargs": {"log_std_init": -1.3},
}
# SyncCarry follows a path for most of its time: its place counts more, and many small updates follow it closely.
CARRY: dict[str, Any] = {
    **OBJECTS,
    "path_speed": True,
    "reward_weights": {"reach": 2.0, "position": 2.0, "orientation": 0.5},
}
CARRY_UNSEEN = ("commanded_q_rad", "time_to_path_s", "progress")  # by the policy, which sees the way to its goal alone
CARRY_SETTINGS: dict[str, Any] = {
    "learning_rate": lambda left: 1e-3 * left,
    "gamma": 0.9,
    "n_steps": 16,
    "batch_size": 512,
    "policy_kwargs": {"log_std_init": -1.6},
}
# Handover as a whole: each step earns what it has changed (`RewardDifferences`). Otherwise holding the block with both
# arms for ever is nearly as good as handing it over. Some episodes begin where the script has come so far.
HANDOVER: dict[str, Any] = {**OBJECTS, "policy_rate_hz": 12.5}
HANDOVER_SHORT, HANDOVER_STEPS = 250, 1_500_000
HANDOVER_UNSEEN = ("commanded_q_rad", "other_gripper_m", "role", "progress")
HELD = {"lift": 0.1, "present": 0.1, "mutual_grasp": 0.1, "release": 0.1}
GRIPPER_STD = 2.0  # times that of the tools: fingers move by centimetres before anything changes
# Handover until the block is lifted: steps of the tools without turns, and half of the decisions.
LIFT: dict[str, Any] = {
    "observation": "goals",
    "action_mode": "tcp_translation",
    "until": "lift",
    "policy_rate_hz": 12.5,
    "object_turn_rad": 0.0,
}
LIFT_SHORT, LIFT_STEPS = 100, 250_000
OBJECTS_SHORT = {"SyncCarry": 900}  # of others 500
OBJECTS_STEPS = {"SyncCarry": 200_000}  # of others 1,500,000


def keywords_of(task: str) -> dict[str, Any]:
    """Return the keywords of the environment that make a task easy to explore."""
    return {SINE: SEEN, "SyncCarry": CARRY}.get(task, OBJECTS)


def settings_of(task: str, algorithm: str = "PPO") -> dict[str, Any]:
    """Return the settings of an algorithm, which has some for tasks with objects if it is PPO."""
    if task == SINE or algorithm != "PPO":
        return SETTINGS[algorithm]
    return CARRY_SETTINGS if task == "SyncCarry" else OBJECTS_SETTINGS


def cells(task: str, algorithm: str, number: int, reward: str = "individual", **keywords: Any) -> CellsVecEnv:
    """Return cells in one batch: a row for each, or one for each arm."""
    if task == SINE and algorithm == "PPO":
        return JointVecEnv(task, number, **keywords)
    return TwoAgentVecEnv(task, number, reward=reward, **keywords)


def measure(
    task: str, algorithm: str, model: BaseAlgorithm, episodes: int, first_seed: int, **keywords: Any
) -> dict[str, float]:
    """Return means of whole episodes without exploration: return, success, and SineTracking's flange error in mm."""
    env = cells(task, algorithm, episodes, reward="shared", **(keywords or keywords_of(task)))
    env.seed(first_seed)
    observation, live = env.reset(), np.ones(env.num_envs, dtype=bool)
    steps, earned, error_mm, success = np.zeros((4, env.num_envs))
    while live.any():
        observation, reward, over, infos = env.step(model.predict(observation, deterministic=True)[0])
        steps += live
        earned += live * reward
        if task == SINE:
            error_mm += live * [1e3 * np.mean(info["flange_error_m"]) for info in infos]
        success += live & over & [bool(info.get("is_success")) for info in infos]
        live &= ~over
    env.close()
    found = {"return": earned.mean(), "success": success.mean()}
    return found | {"error_mm": (error_mm / steps).mean()} if task == SINE else found


def train(
    algorithm: str,
    seed: int,
    steps: int = 0,
    settings: dict[str, Any] | None = None,
    number: int = 0,
    task: str = SINE,
    short: int = 0,
    curve: list[dict[str, float]] | None = None,
    starts: dict[str, float] | None = None,
    unseen: Iterable[str] = (),
    differences: bool = False,
    **keywords: Any,
) -> tuple[BaseAlgorithm, int, float]:
    """Train, print the curve, and return the model, its steps, and the minutes without those of the checks.

    Every 0 means what is usual for the task, and so do no keywords of the environment. Episodes of the training alone
    may begin after stages (`starts`). The policy does not see the fields `unseen`. With `differences` each step earns
    what it has changed. Points of the curve are appended to `curve`.
    """
    keywords = keywords or keywords_of(task)
    torch.set_num_threads(1)  # the cells use the others
    if task == SINE:
        most, usual = STEPS[algorithm], SHORT
    else:
        most, usual = OBJECTS_STEPS.get(task, 1_500_000), OBJECTS_SHORT.get(task, 500)
    chosen = settings_of(task, algorithm) if settings is None else settings
    number, steps = number or CELLS[algorithm], steps or most
    env: VecEnv
    env = made = cells(task, algorithm, number, max_episode_steps=short or usual, starts=starts, **keywords)
    wide = differences and algorithm == "PPO"
    if wide:
        chosen = {**chosen, "gae_lambda": 0.9}
    if differences:
        env = VecNormalize(RewardDifferences(env, chosen["gamma"]), norm_obs=False, gamma=chosen["gamma"])
    rows = env.num_envs // number
    # It learns from episodes with this seed and those that follow.
    first_seed = 1_000_000_000 + 1_000_000 * seed
    model = getattr(stable_baselines3, algorithm)("MlpPolicy", env, seed=first_seed, device="cpu", **chosen)
    hide(model, made.columns(unseen))
    if wide:
        with torch.no_grad():
            model.policy.log_std[-1] += math.log(GRIPPER_STD)
    begin_s, checked_s = time.monotonic(), 0.0

    def check(*_: object) -> bool:
        nonlocal checked_s
        now_s = time.monotonic()
        found = measure(task, algorithm, model, 8, 10_000_000, **keywords)
        minutes = (now_s - begin_s - checked_s) / 60
        if curve is not None:
            curve.append({"steps": model.num_timesteps // rows, "minutes": minutes, **found})
        error = f", flange error {found['error_mm']:5.1f} mm" if task == SINE else ""
        print(
            f"{model.num_timesteps // rows:9} steps, {minutes:5.1f} min: return {found['return']:6.1f}{error}, "
            f"success {100 * found['success']:3.0f} %",
            flush=True,
        )
        checked_s += time.monotonic() - now_s
        return True

    # It counts rows.
    model.learn(rows * steps, callback=EveryNTimesteps(rows * max(10_000, steps // 10), ConvertCallback(check)))
    minutes = (time.monotonic() - begin_s - checked_s) / 60
    env.close()
    return model, model.num_timesteps // rows, minutes


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algorithm", nargs="?", default="PPO", choices=list(SETTINGS))
    parser.add_argument("--task", default=SINE, help="a task whose arms grip objects, or SineTracking")
    parser.add_argument("--lift", action="store_true", help="Handover until the block is lifted")
    parser.add_argument("--steps", type=int, default=0, help="of the environment; 0: as many as the curve has")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", help="new folder of the checkpoint")
    args = parser.parse_args()
    task, seen, steps, further = args.task, keywords_of(args.task), args.steps, dict[str, Any]()
    if args.lift:
        task, seen, steps, further = "Handover", LIFT, steps or LIFT_STEPS, {"short": LIFT_SHORT}
    elif task == "SyncCarry":
        further = {"unseen": CARRY_UNSEEN}
    elif task == "Handover":
        seen, steps = HANDOVER, steps or HANDOVER_STEPS
        further = {"short": HANDOVER_SHORT, "starts": HELD, "unseen": HANDOVER_UNSEEN, "differences": True}
    if task != SINE and args.algorithm != "PPO":
        parser.error(f"{args.algorithm} has settings for {SINE} alone: choose PPO")
    folder = checkpoint.check_new(args.out or f"{task.lower()}_{args.algorithm.lower()}")
    model, _, minutes = train(args.algorithm, args.seed, steps, task=task, **further, **seen)
    print(f"{minutes:.1f} min without the checks")
    if args.algorithm == "TD3":
        model.save(folder)  # a pickle: read only your own
    else:  # a checkpoint holds numbers and text only, is checked against its environment, and runs without torch
        agents = "joint" if task == SINE and args.algorithm == "PPO" else "shared"
        checkpoint.save(folder, *converted(model, f"DualUR10/{task}-v0", agents=agents, **seen))
        settings = " ".join(f"--set '{name}={json.dumps(value)}'" for name, value in seen.items())
        print(f"python -m dual_ur10 evaluate {task} --policy {folder} {settings}")
