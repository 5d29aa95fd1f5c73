"""PPO in one file, on SineTracking, from scratch: python examples/ppo.py [STEPS] [FOLDER] [SEED] [EPISODES].

J. Schulman et al., "Proximal Policy Optimization Algorithms", 2017, with PyTorch and Gymnasium's vector interface
alone. It prints the curve of its training. The result is a checkpoint:

python -m dual_ur10 evaluate SineTracking --policy FOLDER --set observation=goals --set action_scale=0.5
"""

import sys
import time

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

from dual_ur10.policies import evaluate
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import NetworkShape

ENV_ID = "DualUR10/SineTracking-v0"
KEYWORDS = {"observation": "goals", "action_scale": 0.5}
STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 600_000
FOLDER = sys.argv[2] if len(sys.argv) > 2 else "sine_ppo"
SEED = int(sys.argv[3]) if len(sys.argv) > 3 else 0
EPISODES = int(sys.argv[4]) if len(sys.argv) > 4 else 100  # of the evaluation

CELLS, ROLLOUT, EPOCHS, BATCH = 64, 16, 10, 256
RATE, GAMMA, LAMBDA, CLIP = 1e-3, 0.9, 0.95, 0.2
FIRST_LOG_STD = -2.0  # of actions; it is learned, and falls
EPISODE = 100  # steps: an untrained policy is back at the reference before it has drifted far
HIDDEN = 64

checkpoint.check_new(FOLDER)  # before the training, not after it
torch.set_num_threads(1)  # the cells use the others
torch.manual_seed(SEED)
envs = gym.make_vec(ENV_ID, num_envs=CELLS, autoreset_mode="Disabled", max_episode_steps=EPISODE, **KEYWORDS)
SIZE, ACTIONS = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]


def network(outputs: int, gain: float) -> nn.Sequential:
    """Return a network of two hidden layers with orthogonal weights."""
    sizes = ((SIZE, HIDDEN, 2**0.5), (HIDDEN, HIDDEN, 2**0.5), (HIDDEN, outputs, gain))
    layers: list[nn.Module] = []
    for inputs, units, scale in sizes:
        layer = nn.Linear(inputs, units)
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


actor, critic = network(ACTIONS, 0.01), network(1, 1.0)
log_std = nn.Parameter(torch.full((ACTIONS,), FIRST_LOG_STD))
parameters = [*actor.parameters(), log_std, *critic.parameters()]
optimizer = torch.optim.Adam(parameters, lr=RATE, eps=1e-5)


def log_prob(inputs: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    """Return the logarithm of the density of actions, (k,)."""
    return Normal(actor(inputs), log_std.exp()).log_prob(actions).sum(-1)


observation = envs.reset(seed=1_000_000_000 + 1_000_000 * SEED)[0]
begun_s, updates = time.monotonic(), max(1, STEPS // (CELLS * ROLLOUT))
for update in range(updates):
    optimizer.param_groups[0]["lr"] = RATE * (1 - update / updates)

    # Collect a rollout with the policy as it is.
    inputs, actions = torch.empty(ROLLOUT, CELLS, SIZE), torch.empty(ROLLOUT, CELLS, ACTIONS)
    rewards, ends = np.empty((ROLLOUT, CELLS)), np.empty((ROLLOUT, CELLS))
    errors = []
    with torch.no_grad():
        for step in range(ROLLOUT):
            inputs[step] = torch.from_numpy(observation)
            actions[step] = Normal(actor(inputs[step]), log_std.exp()).sample()
            observation, rewards[step], terminated, truncated, info = envs.step(actions[step].clamp(-1, 1).numpy())
            ends[step] = terminated | truncated
            errors.append(info["flange_error_m"].mean())
            cut = np.flatnonzero(truncated & ~terminated)
            if cut.size:  # time ran out, which says nothing of the state: its value counts
                rewards[step, cut] += GAMMA * critic(torch.from_numpy(observation[cut])).numpy()[:, 0]
            if ends[step].any():
                observation = envs.reset(options={"reset_mask": ends[step] > 0})[0]
        values = critic(inputs)[..., 0].numpy()
        following = np.concatenate([values[1:], critic(torch.from_numpy(observation)).numpy().T])
        before = log_prob(inputs, actions).flatten()

    # Generalized advantage estimation (J. Schulman et al., 2016).
    advantages, last = np.empty_like(rewards), np.zeros(CELLS)
    for step in reversed(range(ROLLOUT)):
        goes_on = 1.0 - ends[step]
        last = rewards[step] + GAMMA * goes_on * (following[step] + LAMBDA * last) - values[step]
        advantages[step] = last
    returns = torch.from_numpy((advantages + values).astype(np.float32)).flatten()
    advantage = torch.from_numpy(advantages.astype(np.float32)).flatten()
    inputs, actions = inputs.flatten(0, 1), actions.flatten(0, 1)

    for rows in [part for _ in range(EPOCHS) for part in torch.randperm(len(inputs)).split(BATCH)]:
        ratio = (log_prob(inputs[rows], actions[rows]) - before[rows]).exp()
        gain = (advantage[rows] - advantage[rows].mean()) / (advantage[rows].std() + 1e-8)
        surrogate = torch.minimum(gain * ratio, gain * ratio.clamp(1 - CLIP, 1 + CLIP))
        loss = -surrogate.mean() + 0.5 * (critic(inputs[rows])[:, 0] - returns[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, 0.5)
        optimizer.step()

    if update % 50 == 49 or update == updates - 1:
        minutes, std = (time.monotonic() - begun_s) / 60, log_std.exp().mean().item()
        print(
            f"{(update + 1) * CELLS * ROLLOUT:9} steps, {minutes:5.1f} min, flange error {1e3 * np.mean(errors):5.1f} "
            f"mm while exploring with a standard deviation of {std:.3f}",
            flush=True,
        )

# A checkpoint holds numbers and text only, is checked against its environment, and runs without torch.
layers = [each for each in actor if isinstance(each, nn.Linear)]
weights = [(each.weight.detach().numpy(), each.bias.detach().numpy()) for each in layers]
shape = NetworkShape((SIZE, HIDDEN, HIDDEN, ACTIONS), "tanh", "clip")
signature = checkpoint.signature_of(ENV_ID, **KEYWORDS)
checkpoint.save(FOLDER, [weights], Manifest(signature=signature, agents="joint", network=shape, seed=SEED))
envs.close()

found = evaluate(ENV_ID, FOLDER, episodes=EPISODES, num_envs=min(EPISODES, 50), env_kwargs=KEYWORDS)
print(f"{found.successes} of {EPISODES} episodes succeed, mean return {found.mean_return:.1f}")
