"""Stock Stable-Baselines3, from scratch: python examples/train_with_sb3.py [PPO|SAC|TD3] [--task Handover] [--lift].

It prints the curve of its training: what the policy does without exploration, in whole episodes that it does not learn
from. The result is a checkpoint, with PPO and SAC; the last line that it prints is the
command that evaluates it.
"""

import argparse
import copy
import dataclasses
import json
import math
import os
import time
from typing import Any

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback, EveryNTimesteps
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from dual_ur10.envs.api.sb3_bridge import CellsVecEnv, JointVecEnv, RewardDifferences, TwoAgentVecEnv, hide, scale
from dual_ur10.envs.tasks.goal_fields import GOAL_FIELDS
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.from_sb3 import converted
from dual_ur10.policies.learned.manifest import AgentsKind

SINE = "SineTracking"
CELLS = {"PPO": 64, "SAC": 8, "TD3": 8}
ARM = 6  # actions
LAST_SEED = 3_000  # NumPy's end at 2**32
GRIPPER_STD = 2.0  # times that of the tools: fingers move by centimetres before anything changes
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
# Tasks with objects: one policy for either arm, steps of the tools, wider exploration.
OBJECTS: dict[str, Any] = {"observation": "goals", "action_mode": "tcp_delta"}
OBJECTS_SETTINGS: dict[str, dict[str, Any]] = {
    "PPO": {
        "learning_rate": lambda left: 5e-4 * left,
        "gamma": 0.95,
        "n_steps": 32,
        "batch_size": 1024,
        "policy_kwargs": {"log_std_init": -1.3},
    },
    "SAC": {**SETTINGS["SAC"], "gamma": 0.95},
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recipe:
    """Task, keywords of its environment, and settings of stock learners.

    Attributes:
        task: Short name of the task.
        keywords: Keywords of the environment, in training and evaluation.
        settings: Settings by algorithm.
        steps: Steps of the environment by algorithm.
        short: Steps after which an episode of the training is truncated.
        seen: Fields that the policy sees, where its value function sees all; empty: both see all.
        scaled: What the value function alone sees is scaled by its running mean and deviation.
        starts: Ratios of the training's episodes that begin after stages of the scripted policy.
        differences: Each step earns what it has changed.
        staggered: The cells' first episodes end at different times.
        last_std: Deviation of PPO's actions after nine tenths of the training, to which it falls exponentially; None:
            it is learned.
        best: The result is the policy of the best check, of twice as many checks and four times their episodes.
    """

    task: str
    keywords: dict[str, Any] = dataclasses.field(default_factory=lambda: OBJECTS)
    settings: dict[str, dict[str, Any]] = dataclasses.field(default_factory=lambda: OBJECTS_SETTINGS)
    steps: dict[str, int] = dataclasses.field(default_factory=lambda: {"PPO": 1_500_000, "SAC": 500_000})
    short: int = 500
    seen: tuple[str, ...] = ()
    scaled: bool = False
    starts: dict[str, float] | None = None
    differences: bool = False
    staggered: bool = False
    last_std: float | None = None
    best: bool = False


GOALS = tuple(field.name for field in GOAL_FIELDS)
RECIPES = {
    "SineTracking": Recipe(
        task="SineTracking",
        keywords={"observation": "goals", "action_scale": 0.5},
        settings=SETTINGS,
        steps={"PPO": 600_000, "SAC": 60_000, "TD3": 60_000},
        short=100,  # an untrained policy is back at the reference before it has drifted far
    ),
    # Handover until the block is lifted: steps of the tools without turns, and half of the decisions.
    "lift": Recipe(
        task="Handover",
        keywords={
            "observation": "goals",
            "action_mode": "tcp_translation",
            "until": "lift",
            "policy_rate_hz": 12.5,
            "object_turn_rad": 0.0,
        },
        steps={"PPO": 250_000, "SAC": 40_000},
        short=100,
    ),
    # It follows a path for most of its time: its place counts more, and many small updates follow it closely.
    "SyncCarry": Recipe(
        task="SyncCarry",
        keywords={
            **OBJECTS,
            "path_speed": True,
            "reward_weights": {"reach": 2.0, "position": 2.0, "orientation": 0.5},
        },
        settings={
            "PPO": {
                "learning_rate": lambda left: 1e-3 * left,
                "gamma": 0.9,
                "n_steps": 16,
                "batch_size": 512,
                "policy_kwargs": {"log_std_init": -1.6},
            },
            "SAC": SETTINGS["SAC"],
        },
        steps={"PPO": 200_000, "SAC": 500_000},
        short=900,
        seen=(*GOALS, "path_m_s", "path_rad_s"),
    ),
    # Each step earns what it has changed. Otherwise holding the block with both arms for ever is nearly as good as
    # handing it over. Large batches of all parts of the task move the policy a little at a time.
    "Handover": Recipe(
        task="Handover",
        keywords={"action_mode": "tcp_delta"},
        settings={
            "PPO": {
                "learning_rate": lambda left: 3e-4 * left,
                "gamma": 0.95,
                "gae_lambda": 0.9,
                "n_steps": 32,
                "batch_size": 4096,
                "n_epochs": 10,
                "target_kl": 0.02,
                "policy_kwargs": {"log_std_init": math.log(0.2), "net_arch": [128, 128]},
            },
            "SAC": OBJECTS_SETTINGS["SAC"],
        },
        steps={"PPO": 1_000_000, "SAC": 500_000},
        seen=GOALS,
        scaled=True,
        differences=True,
        staggered=True,
        last_std=0.08,
        best=True,
    ),
}


def recipe_of(task: str) -> Recipe:
    """Return the recipe of a task, or the usual one of tasks with objects."""
    return RECIPES.get(task) or Recipe(task=task)


def cells(task: str, algorithm: str, number: int, reward: str = "individual", **keywords: Any) -> CellsVecEnv:
    """Return cells in one batch: a row for each, or one for each arm."""
    if task == SINE and algorithm == "PPO":
        return JointVecEnv(task, number, **keywords)
    return TwoAgentVecEnv(task, number, reward=reward, **keywords)


def measure(recipe: Recipe, algorithm: str, model: BaseAlgorithm, episodes: int, first_seed: int) -> dict[str, float]:
    """Return means of whole episodes without exploration: return, success, and SineTracking's flange error in mm."""
    env = cells(recipe.task, algorithm, episodes, reward="shared", **recipe.keywords)
    around = model.get_vec_normalize_env()
    env.seed(first_seed)
    observation, live = env.reset(), np.ones(env.num_envs, dtype=bool)
    steps, earned, error_mm, success = np.zeros((4, env.num_envs))
    while live.any():
        seen = observation if around is None else around.normalize_obs(observation)
        observation, reward, over, infos = env.step(model.predict(seen, deterministic=True)[0])
        steps += live
        earned += live * reward
        if recipe.task == SINE:
            error_mm += live * [1e3 * np.mean(info["flange_error_m"]) for info in infos]
        success += live & over & [bool(info.get("is_success")) for info in infos]
        live &= ~over
    env.close()
    found = {"return": earned.mean(), "success": success.mean()}
    return found | {"error_mm": (error_mm / steps).mean()} if recipe.task == SINE else found


class Narrow(BaseCallback):
    """Deviation of PPO's actions that falls from its first value to a last one."""

    def __init__(self, last: float, steps: int) -> None:
        super().__init__()
        self._last, self._steps = last, steps

    def _on_training_start(self) -> None:
        self._log_std = self.model.policy.log_std.requires_grad_(False)
        self._first = self._log_std.clone()

    def _on_rollout_start(self) -> None:
        share = min(1.0, self.num_timesteps / (0.9 * self._steps))
        self._log_std.copy_(self._first + share * (math.log(self._last) - self._first[0]))

    def _on_step(self) -> bool:
        return True


def train(
    recipe: Recipe,
    algorithm: str,
    seed: int,
    steps: int = 0,
    settings: dict[str, Any] | None = None,
    number: int = 0,
    curve: list[dict[str, float]] | None = None,
) -> tuple[BaseAlgorithm, int, float]:
    """Train, print the curve, and return the model, its steps, and the minutes without those of the checks.

    Every 0 means what the recipe has, and so does None. Points of the curve are appended to `curve`.
    """
    torch.set_num_threads(1)  # the cells use the others
    chosen = recipe.settings[algorithm] if settings is None else settings
    number, steps = number or CELLS[algorithm], steps or recipe.steps[algorithm]
    further = {"max_episode_steps": recipe.short, "staggered": recipe.staggered, "starts": recipe.starts}
    env: VecEnv
    env = made = cells(recipe.task, algorithm, number, **further, **recipe.keywords)
    unseen = made.columns(name for name in made.cells.core.layout.names if recipe.seen and name not in recipe.seen)
    if recipe.differences:
        env = RewardDifferences(env, chosen["gamma"])
    if recipe.differences or recipe.scaled:
        env = around = VecNormalize(env, norm_obs=recipe.scaled, gamma=chosen["gamma"])
        if recipe.scaled:
            scale(around, unseen)
    rows = env.num_envs // number
    # It learns from episodes with this seed and those that follow.
    first_seed = 1_000_000_000 + 1_000_000 * seed
    model = getattr(stable_baselines3, algorithm)("MlpPolicy", env, seed=first_seed, device="cpu", **chosen)
    hide(model, unseen)
    begin_s, checked_s = time.monotonic(), 0.0
    checks, episodes = (20, 32) if recipe.best else (10, 8)
    best, kept = (0.0, -math.inf), dict[str, Any]()

    def check(*_: object) -> bool:
        nonlocal checked_s, best, kept
        now_s = time.monotonic()
        found = measure(recipe, algorithm, model, episodes, 10_000_000)
        if recipe.best and (found["success"], found["return"]) > best:
            best, kept = (found["success"], found["return"]), copy.deepcopy(model.policy.state_dict())
        minutes = (now_s - begin_s - checked_s) / 60
        if curve is not None:
            curve.append({"steps": model.num_timesteps // rows, "minutes": minutes, **found})
        error = f", flange error {found['error_mm']:5.1f} mm" if recipe.task == SINE else ""
        print(
            f"{model.num_timesteps // rows:9} steps, {minutes:5.1f} min: return {found['return']:6.1f}{error}, "
            f"success {100 * found['success']:3.0f} %",
            flush=True,
        )
        checked_s += time.monotonic() - now_s
        return True

    # It counts rows.
    every = rows * max(10_000, steps // checks)
    callbacks: list[BaseCallback] = [EveryNTimesteps(every, ConvertCallback(check))]
    if recipe.last_std is not None and algorithm == "PPO":
        with torch.no_grad():
            model.policy.log_std[-1] += math.log(GRIPPER_STD)
        callbacks.append(Narrow(recipe.last_std, rows * steps))
    model.learn(rows * steps, callback=CallbackList(callbacks))
    minutes = (time.monotonic() - begin_s - checked_s) / 60
    if kept:
        model.policy.load_state_dict(kept)
    env.close()
    return model, model.num_timesteps // rows, minutes


def save(recipe: Recipe, algorithm: str, model: BaseAlgorithm, folder: str | os.PathLike[str]) -> None:
    """Save a model as a checkpoint in a new folder."""
    agents: AgentsKind = "joint" if recipe.task == SINE and algorithm == "PPO" else "shared"
    around, env_id = model.get_vec_normalize_env(), f"DualUR10/{recipe.task}-v0"
    checkpoint.save(folder, *converted(model, env_id, agents=agents, vec_normalize=around, **recipe.keywords))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algorithm", nargs="?", default="PPO", choices=list(SETTINGS))
    parser.add_argument("--task", default=SINE, help="a task whose arms grip objects, or SineTracking")
    parser.add_argument("--lift", action="store_true", help="Handover until the block is lifted")
    parser.add_argument("--steps", type=int, default=0, help="of the environment; 0: as many as the curve has")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", help="new folder of the checkpoint")
    args = parser.parse_args()
    recipe = recipe_of("lift" if args.lift else args.task)
    if not 0 <= args.seed <= LAST_SEED:
        parser.error(f"the seed is {args.seed}: choose one from 0 to {LAST_SEED}")
    if args.algorithm not in recipe.settings:
        parser.error(f"{args.algorithm} has settings for {SINE} alone: choose {' or '.join(recipe.settings)}")
    out = args.out or f"{recipe.task.lower()}_{args.algorithm.lower()}"
    folder = checkpoint.check_new(f"{out}.zip" if args.algorithm == "TD3" else out)
    model, _, minutes = train(recipe, args.algorithm, args.seed, args.steps)
    print(f"{minutes:.1f} min without the checks")
    if args.algorithm == "TD3":
        model.save(folder)  # a pickle: read only your own
    else:  # a checkpoint holds numbers and text only, is checked against its environment, and runs without torch
        save(recipe, args.algorithm, model, folder)
        settings = " ".join(f"--set '{name}={json.dumps(value)}'" for name, value in recipe.keywords.items())
        print(f"python -m dual_ur10 evaluate {recipe.task} --policy {folder} {settings}")
