"""TorchRL's PPO on SineTracking, from scratch: python examples/ppo_with_torchrl.py [STEPS] [FOLDER] [SEED] [EPISODES].

It prints the curve of its training. The result is a checkpoint:

python -m dual_ur10 evaluate SineTracking --policy FOLDER --set observation=goals --set action_scale=0.5
"""

import sys
import time

import gymnasium as gym
import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from dual_ur10.policies import evaluate
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import NetworkShape

ENV_ID = "DualUR10/SineTracking-v0"
KEYWORDS = {"observation": "goals", "action_scale": 0.5}
STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 600_000
FOLDER = sys.argv[2] if len(sys.argv) > 2 else "sine_torchrl"
SEED = int(sys.argv[3]) if len(sys.argv) > 3 else 0
EPISODES = int(sys.argv[4]) if len(sys.argv) > 4 else 100  # of the evaluation
CELLS, ROLLOUT, EPOCHS, BATCH, RATE, HIDDEN = 64, 16, 10, 256, 1e-3, 64

checkpoint.check_new(FOLDER)  # before the training, not after it
torch.set_num_threads(1)  # the cells use the others
torch.manual_seed(SEED)


def network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    """Return a network of two hidden layers with orthogonal weights."""
    layers = [nn.Linear(inputs, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, outputs)]
    for layer, scale in zip(layers[::2], (2**0.5, 2**0.5, gain), strict=True):
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)


# Short episodes: an untrained policy is back at the reference before it has drifted far.
env = GymWrapper(
    gym.make_vec(ENV_ID, num_envs=CELLS, autoreset_mode="Disabled", max_episode_steps=100, **KEYWORDS)
)  # TorchRL resets cells by itself
env.set_seed(1_000_000_000 + 1_000_000 * SEED)
size, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
head = AddStateIndependentNormalScale(actions)
nn.init.constant_(head.state_independent_scale, -2.0)
actor = ProbabilisticActor(
    TensorDictModule(nn.Sequential(network(size, actions, 0.01), head), ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=IndependentNormal,
    return_log_prob=True,
)
critic = ValueOperator(network(size, 1, 1.0), in_keys=["observation"])
advantage = GAE(gamma=0.9, lmbda=0.95, value_network=critic)
loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, critic_coeff=0.5, loss_critic_type="l2", normalize_advantage=True)
optimizer = torch.optim.Adam(loss.parameters(), lr=RATE, eps=1e-5)
collector = Collector(env, actor, frames_per_batch=CELLS * ROLLOUT, total_frames=STEPS)

begun_s, updates, collected = time.monotonic(), max(1, STEPS // (CELLS * ROLLOUT)), 0
for update, batch in enumerate(collector):
    optimizer.param_groups[0]["lr"] = RATE * max(0.0, 1 - update / updates)
    with torch.no_grad():
        advantage(batch)
    samples = batch.reshape(-1)
    for rows in [part for _ in range(EPOCHS) for part in torch.randperm(len(samples)).split(BATCH)]:
        found = loss(samples[rows])
        optimizer.zero_grad()
        (found["loss_objective"] + found["loss_critic"]).backward()
        nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
        optimizer.step()
    collected += len(samples)
    if update % 50 == 49 or collected >= STEPS:
        minutes, std = (time.monotonic() - begun_s) / 60, head.state_independent_scale.exp().mean().item()
        reward = samples["next", "reward"].mean().item()
        print(f"{collected:9} steps, {minutes:5.1f} min, reward {reward:.3f} per step, deviation {std:.3f}", flush=True)
collector.shutdown()

# A checkpoint holds numbers and text only, is checked against its environment, and runs without torch.
layers = [each for each in actor.modules() if isinstance(each, nn.Linear)]
weights = [(each.weight.detach().numpy(), each.bias.detach().numpy()) for each in layers]
shape = NetworkShape((size, HIDDEN, HIDDEN, actions), "tanh", "clip")
signature = checkpoint.signature_of(ENV_ID, **KEYWORDS)
checkpoint.save(FOLDER, [weights], Manifest(signature=signature, agents="joint", network=shape, seed=SEED))

found = evaluate(ENV_ID, FOLDER, episodes=EPISODES, num_envs=min(EPISODES, 50), env_kwargs=KEYWORDS)
print(f"{found.successes} of {EPISODES} episodes succeed, mean return {found.mean_return:.1f}")
