"""PPO in one file, on SineTracking, from scratch: python examples/ppo.py [STEPS] [FOLDER] [SEED] [EPISODES].

J. Schulman et al., "Proximal Policy Optimization Algorithms", 2017. One network acts for each arm by itself, from its
commanded joints and the step from there to its reference, and learns from the reward of its arm alone. The result is a
checkpoint: python -m dual_ur10 evaluate SineTracking --policy FOLDER. `python -m dual_ur10 train SineTracking --algo
ppo` does the same with Stable-Baselines3.
"""

import sys
import time

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

from dual_ur10.envs.tasks.sine_tracking.task import SineTracking
from dual_ur10.policies import evaluate
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import NetworkShape, Normaliser

ENV_ID = "DualUR10/SineTracking-v0"
STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
FOLDER = sys.argv[2] if len(sys.argv) > 2 else "sine_ppo"
SEED = int(sys.argv[3]) if len(sys.argv) > 3 else 0
EPISODES = int(sys.argv[4]) if len(sys.argv) > 4 else 100  # of the evaluation

CELLS, ROLLOUT, EPOCHS, BATCH = 64, 16, 5, 256
RATE, GAMMA, LAMBDA, CLIP = 1e-3, 0.9, 0.9, 0.2
FIRST_STD, LAST_STD = 0.1, 0.006  # of actions: in the end the arms must follow them without lag
EPISODE = 100  # steps: an untrained policy is back at the reference before it has drifted far
HIDDEN = 64
SEEN = SineTracking.layout.indices(("commanded_q_rad", "step_m", "step_rad"))  # of an arm's observation
SIZE, ACTIONS = len(SEEN), 6

torch.set_num_threads(1)  # the cells use the others
torch.manual_seed(SEED)
envs = gym.make_vec(ENV_ID, num_envs=CELLS, autoreset_mode="Disabled", max_episode_steps=EPISODE)
core = envs.unwrapped.core
ROWS = 2 * CELLS


def seen(observation: np.ndarray) -> np.ndarray:
    """Return what each arm sees, (2 k, size), of observations of both, (k, 94)."""
    return observation.reshape(2 * len(observation), -1)[:, SEEN]


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

observation = seen(envs.reset(seed=1_000_000_000 + 1_000_000 * SEED)[0])
moments.add(observation)
begun_s, updates = time.monotonic(), max(1, STEPS // (CELLS * ROLLOUT))
for update in range(updates):
    share = update / updates
    std = FIRST_STD * (LAST_STD / FIRST_STD) ** min(1.0, share / 0.9)
    optimizer.param_groups[0]["lr"] = RATE * (1 - share)

    # Collect a rollout with the policy as it is.
    raw, rewards, ends = np.empty((ROLLOUT, ROWS, SIZE)), np.empty((ROLLOUT, ROWS)), np.empty((ROLLOUT, ROWS))
    inputs, actions = torch.empty(ROLLOUT, ROWS, SIZE), torch.empty(ROLLOUT, ROWS, ACTIONS)
    with torch.no_grad():
        for step in range(ROLLOUT):
            raw[step], inputs[step] = observation, moments(observation)
            actions[step] = Normal(actor(inputs[step]), std).sample()
            both, _, terminated, truncated, _ = envs.step(actions[step].clamp(-1, 1).numpy().reshape(CELLS, -1))
            over, observation = terminated | truncated, seen(both)
            rewards[step], ends[step] = core.agents.rewards.reshape(-1), np.repeat(over, 2)
            cut = np.flatnonzero(np.repeat(truncated & ~terminated, 2))
            if cut.size:  # time ran out, which says nothing of the state: its value counts
                rewards[step, cut] += GAMMA * critic(moments(observation[cut])).numpy()[:, 0]
            if over.any():
                observation = seen(envs.reset(options={"reset_mask": over})[0])
        values = critic(inputs)[..., 0].numpy()
        following = np.concatenate([values[1:], critic(moments(observation)).numpy().T])
        before = Normal(actor(inputs), std).log_prob(actions).sum(-1).flatten()
    moments.add(raw.reshape(-1, SIZE))

    # Generalized advantage estimation (J. Schulman et al., 2016).
    advantages, last = np.empty_like(rewards), np.zeros(ROWS)
    for step in reversed(range(ROLLOUT)):
        goes_on = 1.0 - ends[step]
        last = rewards[step] + GAMMA * goes_on * (following[step] + LAMBDA * last) - values[step]
        advantages[step] = last
    returns = torch.from_numpy((advantages + values).astype(np.float32)).flatten()
    advantage = torch.from_numpy(advantages.astype(np.float32)).flatten()
    inputs, actions = inputs.flatten(0, 1), actions.flatten(0, 1)

    for rows in [part for _ in range(EPOCHS) for part in torch.randperm(len(inputs)).split(BATCH)]:
        ratio = (Normal(actor(inputs[rows]), std).log_prob(actions[rows]).sum(-1) - before[rows]).exp()
        gain = (advantage[rows] - advantage[rows].mean()) / (advantage[rows].std() + 1e-8)
        surrogate = torch.minimum(gain * ratio, gain * ratio.clamp(1 - CLIP, 1 + CLIP))
        loss = -surrogate.mean() + 0.25 * (critic(inputs[rows])[:, 0] - returns[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, 0.5)
        optimizer.step()

    if update % 200 == 199 or update == updates - 1:
        minutes = (time.monotonic() - begun_s) / 60
        print(f"{(update + 1) * CELLS * ROLLOUT:9} steps, {minutes:.1f} min, reward {rewards.mean():.3f} per step")

# A checkpoint holds numbers and text only, is checked against its environment, and runs without torch. Its network
# takes the whole observation of an agent: weights of what it does not see are 0.
layers = [each for each in actor if isinstance(each, nn.Linear)]
weights = [(each.weight.detach().numpy(), each.bias.detach().numpy()) for each in layers]
AGENT = SineTracking.layout.size
first, mean, var = np.zeros((HIDDEN, AGENT), np.float32), np.zeros(AGENT), np.ones(AGENT)
first[:, SEEN], mean[SEEN], var[SEEN] = weights[0][0], moments.mean, moments.var
weights[0] = first, weights[0][1]
manifest = Manifest(
    signature=checkpoint.signature_of(ENV_ID),
    agents="shared",
    network=NetworkShape((AGENT, HIDDEN, HIDDEN, ACTIONS), "tanh", "clip"),
    normalisers=(Normaliser(tuple(mean.tolist()), tuple(var.tolist())),),
    seed=SEED,
)
checkpoint.save(FOLDER, [weights], manifest)
envs.close()

found = evaluate(ENV_ID, FOLDER, episodes=EPISODES, num_envs=min(EPISODES, 50))
print(f"{found.successes} of {EPISODES} episodes succeed, mean return {found.mean_return:.1f}")
