"""Collect a Minari dataset and read it with Minari alone: python examples/collect_dataset.py [EPISODES] [NAME]."""

import sys

import minari

from dual_ur10.policies.training.dataset import collect

episodes = int(sys.argv[1]) if len(sys.argv) > 1 else 20
name = sys.argv[2] if len(sys.argv) > 2 else "dual-ur10/sinetracking/example-v0"

keywords = {"randomization": "mild", "action_latency_ticks": 5}
collect("SineTracking", name, episodes=episodes, seed=100_000, env_kwargs=keywords)

dataset = minari.load_dataset(name)
print(f"{dataset.total_episodes} episodes, {dataset.total_steps} steps of {dataset.spec.env_spec.id}")
episode = dataset[0]
for agent in ("left", "right"):
    print(agent, episode.observations[agent].shape, episode.actions[agent].shape)
