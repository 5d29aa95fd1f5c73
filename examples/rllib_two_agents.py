"""Two agents on Ray RLlib: python examples/rllib_two_agents.py [ITERATIONS] [two|joint] [FOLDER].

It prints the curve of its training: mean returns of episodes of 4 s, of which 100 is the most. With a policy for each
arm the result is a checkpoint:

python -m dual_ur10 evaluate SineTracking --policy FOLDER --set observation=goals --set action_scale=0.5
"""

import math
import os
import sys

# Ray reads these on import. With the first it opens ports on 127.0.0.1 only, which its _node_ip_address does not
# ensure. On a cluster leave out the first, and call ray.init("auto").
os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"

import ray
import torch
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from dual_ur10.envs import parallel_env
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import NetworkShape

RUNNERS = 2  # processes that step environments; Ray puts them where a CPU is free
SEEN = {"observation": "goals", "action_scale": 0.5}
SHORT = 100  # steps of an episode: an untrained policy is back at the reference before it has drifted far
HIDDEN = 64


class Narrow(DefaultPPOTorchRLModule):
    """RLlib's network whose actions vary little from the beginning. Their standard deviation is learned."""

    def setup(self) -> None:
        """Make the network."""
        super().setup()
        torch.nn.init.constant_(self.pi.log_std, -2.0)


def ppo(iterations: int) -> PPOConfig:
    """Return the settings that both ways of training share."""
    config = PPOConfig().framework("torch").debugging(seed=0)
    config.env_runners(num_env_runners=RUNNERS, num_envs_per_env_runner=8)
    network = DefaultModelConfig(
        fcnet_hiddens=[HIDDEN, HIDDEN], fcnet_activation="tanh", vf_share_layers=False, free_log_std=True
    )
    config.rl_module(rl_module_spec=RLModuleSpec(module_class=Narrow, model_config=network))
    batch = 1024  # many small updates
    return config.training(
        lr=[[0, 1e-3], [batch * iterations, 1e-5]],
        gamma=0.9,
        lambda_=0.95,
        use_kl_loss=False,
        clip_param=0.2,
        vf_clip_param=100.0,
        grad_clip=0.5,
        train_batch_size_per_learner=batch,
        minibatch_size=256,
        num_epochs=10,
    )


def two_agents(iterations: int = 1200) -> PPOConfig:
    """Use the PettingZoo interface: a policy for each arm."""
    register_env("two_arms", lambda config: ParallelPettingZooEnv(parallel_env("SineTracking", **config)))
    config = ppo(iterations).environment("two_arms", env_config={"reward": "individual", "max_cycles": SHORT, **SEEN})
    # For one policy that moves either arm: policies={"either"}, and a function that always returns "either".
    return config.multi_agent(policies={"left", "right"}, policy_mapping_fn=lambda agent, episode, **keywords: agent)


def joint_policy(iterations: int = 1200) -> PPOConfig:
    """Use the Gymnasium interface: one policy for both arms. The part before the colon registers the id."""
    keywords = {"max_episode_steps": SHORT, **SEEN}
    return ppo(iterations).environment("dual_ur10:DualUR10/SineTracking-v0", env_config=keywords)


def save(algorithm: Algorithm, folder: str) -> None:
    """Save the networks of both arms, which are plain arrays, as a checkpoint."""
    networks = []
    for name in ("left", "right"):
        module = algorithm.get_module(name)
        layers = *module.encoder.actor_encoder.modules(), *module.pi.modules()
        linear = [each for each in layers if isinstance(each, torch.nn.Linear)]
        networks.append([(each.weight.detach().numpy(), each.bias.detach().numpy()) for each in linear])
    sizes = (networks[0][0][0].shape[1], *(len(bias) for _, bias in networks[0]))
    signature = checkpoint.signature_of("DualUR10/SineTracking-v0", **SEEN)
    shape = NetworkShape(sizes, "tanh", "clip")
    checkpoint.save(folder, networks, Manifest(signature=signature, agents="independent", network=shape))


if __name__ == "__main__":
    iterations = int(sys.argv[1]) if len(sys.argv) > 1 else 1200
    joint = sys.argv[2:3] == ["joint"]
    folder = None if joint else checkpoint.check_new(sys.argv[3] if len(sys.argv) > 3 else "sine_rllib")
    ray.init("local", num_cpus=RUNNERS, include_dashboard=False)
    try:
        algorithm = (joint_policy if joint else two_agents)(iterations).build_algo()
        for iteration in range(1, iterations + 1):
            found = algorithm.train()["env_runners"]
            returns = found.get("agent_episode_returns_mean") or {"both": found.get("episode_return_mean", math.nan)}
            # A batch is shorter than an episode: in some iterations none ends.
            if not any(math.isnan(value) for value in returns.values()):
                print(iteration, {name: round(float(value), 2) for name, value in returns.items()}, flush=True)
        if folder is not None:
            save(algorithm, str(folder))
        algorithm.stop()
    finally:
        ray.shutdown()
