"""Train with plain Stable-Baselines3 in twenty lines: python examples/train_with_sb3.py [STEPS] [FOLDER]."""

import sys

from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from dual_ur10.envs.api.sb3_bridge import JointVecEnv
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.from_sb3 import converted

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
folder = sys.argv[2] if len(sys.argv) > 2 else "sine_ppo"

# Short episodes return an untrained policy to the reference before it has drifted far.
env = VecNormalize(VecMonitor(JointVecEnv("SineTracking", 64, max_episode_steps=100)), gamma=0.9)
options = {"learning_rate": 1e-3, "gamma": 0.9, "gae_lambda": 0.9, "device": "cpu", "verbose": 1}
network = {"net_arch": [64, 64], "log_std_init": -1.6}
model = PPO("MlpPolicy", env, n_steps=32, batch_size=512, n_epochs=5, policy_kwargs=network, **options)
model.learn(steps)

# A checkpoint holds numbers and text only, is checked against its environment, and runs without torch.
checkpoint.save(folder, *converted(model, "DualUR10/SineTracking-v0", vec_normalize=env))
env.close()
