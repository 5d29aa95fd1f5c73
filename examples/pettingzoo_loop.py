"""Two agents, a plain loop of PettingZoo: python examples/pettingzoo_loop.py [STEPS]."""

import sys

from dual_ur10.envs import parallel_env

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 100

env = parallel_env("Handover", giver="random", reward="individual")
observations, infos = env.reset(seed=0)
totals = dict.fromkeys(env.possible_agents, 0.0)
for _ in range(steps):
    if not env.agents:
        observations, infos = env.reset()
    actions = {agent: env.action_space(agent).sample() for agent in env.agents}
    observations, rewards, terminations, truncations, infos = env.step(actions)
    for agent, reward in rewards.items():
        totals[agent] += reward
print({agent: round(total, 3) for agent, total in totals.items()})
env.close()
