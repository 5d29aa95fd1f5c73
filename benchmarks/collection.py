"""Rate of rollout collection for PPO: cells in one batch, compared with one process per environment.

python benchmarks/collection.py [--task SineTracking] [--envs 64] [--blocks 9] [--json FILE]

Both run the same PPO of Stable-Baselines3, which collects rollouts with its own network, torch on one thread: with
`JointVecEnv` of 64 cells, and with `SubprocVecEnv` of Stable-Baselines3 with one environment per core. Blocks of both
alternate in one run. The median ratio is quoted: it depends less on the machine than rates do. The rate of a whole
training, updates included, is that of PPO with the batch.
"""

import argparse
import json
import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import statistics
import time
from pathlib import Path

import gymnasium as gym
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecMonitor, VecNormalize

import dual_ur10
from dual_ur10.envs.api.sb3_bridge import JointVecEnv
from dual_ur10.ids import env_id_of

KEYWORDS = {"randomization": "mild", "action_latency_ticks": 5}


def make_one(env_id: str):
    """Return a function that makes one environment, for a process of its own."""

    def make() -> gym.Env:
        return gym.make(env_id, **KEYWORDS)

    return make


class Collector:
    """Model that collects rollouts without learning."""

    def __init__(self, env: VecEnv, steps: int) -> None:
        self.env = VecNormalize(VecMonitor(env))
        batch = steps * env.num_envs
        self.model = PPO("MlpPolicy", self.env, n_steps=steps, batch_size=min(batch, 1024), device="cpu", seed=0)
        self.callback = CallbackList([])
        self.model._setup_learn(1, self.callback)
        self.callback.init_callback(self.model)
        self.steps = batch

    def __call__(self) -> float:
        """Return environment steps per second of one rollout."""
        begin = time.perf_counter()
        self.model.collect_rollouts(self.env, self.callback, self.model.rollout_buffer, self.model.n_steps)
        return self.steps / (time.perf_counter() - begin)


def whole(env: VecEnv, updates: int) -> float:
    """Return steps per second of a training with five epochs per update."""
    around = VecNormalize(VecMonitor(env))
    model = PPO("MlpPolicy", around, n_steps=64, batch_size=1024, n_epochs=5, device="cpu", seed=0)
    begin = time.perf_counter()
    model.learn(64 * env.num_envs * updates)
    return model.num_timesteps / (time.perf_counter() - begin)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="SineTracking")
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--blocks", type=int, default=9)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    cores = len(os.sched_getaffinity(0))
    print(f"load {os.getloadavg()[0]:.2f}, {cores} cores, dual_ur10 {dual_ur10.__version__}")
    one = Collector(JointVecEnv(args.task, args.envs, **KEYWORDS), 16)
    many = Collector(SubprocVecEnv([make_one(env_id_of(args.task))] * cores, start_method="spawn"), 256)
    rates: list[tuple[float, float]] = []
    try:
        one(), many()
        for _ in range(args.blocks):
            rates.append((one(), many()))
    finally:
        one.env.close()
        many.env.close()
    batch, processes = (statistics.median(each) for each in zip(*rates, strict=True))
    ratio = statistics.median(a / b for a, b in rates)
    env = JointVecEnv(args.task, args.envs, **KEYWORDS)
    ppo = whole(env, 6)
    env.close()
    print(f"{args.task}: {args.envs} cells in one batch {batch:8.0f} steps/s")
    print(f"{args.task}: SubprocVecEnv, {cores} processes {processes:8.0f} steps/s, ratio {ratio:.2f}")
    print(f"{args.task}: PPO, updates included {ppo:8.0f} steps/s")
    if args.json is not None:
        found = {"batch_steps_s": batch, "subproc_steps_s": processes, "ratio": ratio, "ppo_steps_s": ppo}
        args.json.write_text(json.dumps({args.task: found, "cores": cores, "envs": args.envs}, indent=1) + "\n")


if __name__ == "__main__":
    main()
