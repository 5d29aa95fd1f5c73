"""PPO in one file, on SineTracking, from nothing: python examples/ppo.py [STEPS] [FOLDER] [SEED].

J. Schulman et al., "Proximal Policy Optimization Algorithms", 2017. The result is a checkpoint:
python -m dual_ur10 evaluate SineTracking --policy FOLDER. `python -m dual_ur10 train SineTracking --algo ppo` does the
same with Stable-Baselines3.
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
from dual_ur10.policies.learned.network import NetworkShape, Normaliser

ENV_ID = "DualUR10/SineTracking-v0"
STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 5_000_000
FOLDER = sys.argv[2] if len(sys.argv) > 2 else "sine_ppo"
SEED = int(sys.argv[3]) if len(sys.argv) > 3 else 0

CELLS, ROLLOUT, EPOCHS, BATCH = 64, 32, 5, 512
RATE, GAMMA, LAMBDA, CLIP = 1e-3, 0.9, 0.9, 0.2
FIRST_STD, LAST_STD = 0.2, 0.02  # of actions: exploration becomes as narrow as the error that is left
EPISODE = 100  # steps: an untrained policy is back at the reference before it has drifted far
HIDDEN = 64

torch.set_num_threads(1)  # the cells use the others
torch.manual_seed(SEED)
envs = gym.make_vec(ENV_ID, num_envs=CELLS, autoreset_mode="SameStep", max_episode_steps=EPISODE)
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


class Moments:
    """Running mean and variance of observations."""

    def __init__(self) -> None:
        self.mean, self.var, self.count = np.zeros(SIZE), np.ones(SIZE), 1e-4

    def add(self, values: np.ndarray) -> None:
        """Take more of them, (k, size)."""
        count = self.count + len(values)
        off = values.mean(axis=0) - self.mean
        squares = self.var * self.count + values.var(axis=0) * len(values)
        self.var = (squares + off**2 * self.count * len(values) / count) / count
        self.mean, self.count = self.mean + off * len(values) / count, count

    def __call__(self, values: np.ndarray) -> torch.Tensor:
        """Return them normalised, as float32."""
        return torch.from_numpy(((values - self.mean) / np.sqrt(self.var + 1e-8)).clip(-10, 10).astype(np.float32))


actor, critic, moments = network(ACTIONS, 0.01), network(1, 1.0), Moments()
parameters = [*actor.parameters(), *critic.parameters()]
optimizer = torch.optim.Adam(parameters, lr=RATE, eps=1e-5)

observation, _ = envs.reset(seed=1_000_000_000 + 1_000_000 * SEED)
moments.add(observation)
begun_s, updates = time.monotonic(), max(1, STEPS // (CELLS * ROLLOUT))
for update in range(updates):
    share = update / updates
    std = FIRST_STD * (LAST_STD / FIRST_STD) ** min(1.0, share / 0.9)
    optimizer.param_groups[0]["lr"] = RATE * (1 - share)

    # Collect a rollout with the policy as it is.
    raw, rewards, ends = np.empty((ROLLOUT, CELLS, SIZE)), np.empty((ROLLOUT, CELLS)), np.empty((ROLLOUT, CELLS))
    inputs, actions = torch.empty(ROLLOUT, CELLS, SIZE), torch.empty(ROLLOUT, CELLS, ACTIONS)
    with torch.no_grad():
        for step in range(ROLLOUT):
            raw[step], inputs[step] = observation, moments(observation)
            actions[step] = Normal(actor(inputs[step]), std).sample()
            action = actions[step].clamp(-1, 1).numpy()
            observation, reward, terminated, truncated, info = envs.step(action)
            rewards[step], ends[step] = reward, terminated | truncated
            cut = np.flatnonzero(truncated & ~terminated)
            if cut.size:  # time ran out, which says nothing of the state: its value counts
                final = np.stack([info["final_obs"][row] for row in cut])
                rewards[step, cut] += GAMMA * critic(moments(final)).numpy()[:, 0]
        values = critic(inputs)[..., 0].numpy()
        following = np.concatenate([values[1:], critic(moments(observation)).numpy().T])
        before = Normal(actor(inputs), std).log_prob(actions).sum(-1).flatten()
    moments.add(raw.reshape(-1, SIZE))

    # Generalized advantage estimation (J. Schulman et al., 2016).
    advantages, last = np.empty_like(rewards), np.zeros(CELLS)
    for step in reversed(range(ROLLOUT)):
        goes_on = 1.0 - ends[step]
        last = rewards[step] + GAMMA * goes_on * (following[step] + LAMBDA * last) - values[step]
        advantages[step] = last
    returns = torch.from_numpy((advantages + values).astype(np.float32)).flatten()
    advantage = torch.from_numpy(advantages.astype(np.float32)).flatten()
    inputs, actions = inputs.flatten(0, 1), actions.flatten(0, 1)

    for _ in range(EPOCHS):
        for rows in torch.randperm(len(inputs)).split(BATCH):
            after = Normal(actor(inputs[rows]), std).log_prob(actions[rows]).sum(-1)
            ratio = (after - before[rows]).exp()
            gain = (advantage[rows] - advantage[rows].mean()) / (advantage[rows].std() + 1e-8)
            surrogate = torch.minimum(gain * ratio, gain * ratio.clamp(1 - CLIP, 1 + CLIP))
            loss = -surrogate.mean() + 0.25 * (critic(inputs[rows])[:, 0] - returns[rows]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, 0.5)
            optimizer.step()

    if update % 100 == 99 or update == updates - 1:
        minutes = (time.monotonic() - begun_s) / 60
        print(f"{(update + 1) * CELLS * ROLLOUT:9} steps, {minutes:.1f} min, reward {rewards.mean():.3f} per step")

# A checkpoint holds numbers and text only, is checked against its environment, and runs without torch.
layers = [each for each in actor if isinstance(each, nn.Linear)]
weights = [(each.weight.detach().numpy(), each.bias.detach().numpy()) for each in layers]
manifest = Manifest(
    signature=checkpoint.signature_of(ENV_ID),
    agents="joint",
    network=NetworkShape((SIZE, HIDDEN, HIDDEN, ACTIONS), "tanh", "clip"),
    normalisers=(Normaliser(tuple(moments.mean.tolist()), tuple(moments.var.tolist())),),
    seed=SEED,
)
checkpoint.save(FOLDER, [weights], manifest)
envs.close()

found = evaluate(ENV_ID, FOLDER, episodes=100, num_envs=50)
print(f"{found.successes} of 100 episodes succeed, mean return {found.mean_return:.1f}")
