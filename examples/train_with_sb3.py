"""Train with plain Stable-Baselines3 in twenty lines: python examples/train_with_sb3.py [STEPS] [FOLDER]."""

import sys

from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from dual_ur10.envs.api.sb3_bridge import JointVecEnv
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.from_sb3 import converted

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
folder = sys.argv[2] if len(sys.argv) > 2 else "sine_ppo"

keywords = {"randomization": "mild", "action_latency_ticks": 5}
env = VecNormalize(VecMonitor(JointVecEnv("SineTracking", 32, **keywords)))
model = PPO("MlpPolicy", env, n_steps=64, batch_size=512, device="cpu", verbose=1)
model.learn(steps)

# A checkpoint holds numbers and text only, is checked against its environment, and runs without torch.
checkpoint.save(folder, *converted(model, "DualUR10/SineTracking-v0", vec_normalize=env, **keywords))
env.close()
