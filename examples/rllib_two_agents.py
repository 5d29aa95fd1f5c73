"""Two agents on Ray RLlib: python examples/rllib_two_agents.py [ITERATIONS] [two|joint]."""

import os
import sys

# Ray reads these on import. With the first it opens ports on 127.0.0.1 only, which its _node_ip_address does not
# ensure. On a cluster leave out the first, and call ray.init("auto").
os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"

import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.env_to_module import MeanStdFilter
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from dual_ur10.envs import parallel_env

RUNNERS = 2  # processes that step environments; Ray puts them where a CPU is free
KEYWORDS = {"duration_s": 10.0, "randomization": "mild", "action_latency_ticks": 5}


def ppo(agents: int) -> PPOConfig:
    """Return the settings that both ways of training share."""
    config = PPOConfig().framework("torch").debugging(seed=0)
    config.env_runners(
        num_env_runners=RUNNERS,
        num_envs_per_env_runner=8,
        env_to_module_connector=lambda env, spaces, device: MeanStdFilter(multi_agent=agents > 1),
    )
    return config.training(lr=3e-4, lambda_=0.95, train_batch_size_per_learner=4000, minibatch_size=500, num_epochs=5)


def two_agents() -> PPOConfig:
    """Use the PettingZoo interface: a policy for each arm."""
    register_env("two_arms", lambda config: ParallelPettingZooEnv(parallel_env("SineTracking", **config)))
    config = ppo(agents=2).environment("two_arms", env_config={"reward": "individual", **KEYWORDS})
    # For one policy that moves either arm: policies={"either"}, and a function that always returns "either".
    return config.multi_agent(policies={"left", "right"}, policy_mapping_fn=lambda agent, episode, **keywords: agent)


def joint_policy() -> PPOConfig:
    """Use the Gymnasium interface: one policy for both arms. The part before the colon registers the id."""
    return ppo(agents=1).environment("dual_ur10:DualUR10/SineTracking-v0", env_config=KEYWORDS)


if __name__ == "__main__":
    iterations = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    config = joint_policy() if sys.argv[2:] == ["joint"] else two_agents()
    ray.init("local", num_cpus=RUNNERS, include_dashboard=False)
    try:
        algorithm = config.build_algo()
        for iteration in range(1, iterations + 1):
            found = algorithm.train()["env_runners"]
            returns = found.get("agent_episode_returns_mean") or {"both": found["episode_return_mean"]}
            print(iteration, {name: round(float(value), 2) for name, value in returns.items()}, flush=True)
        algorithm.stop()
    finally:
        ray.shutdown()
