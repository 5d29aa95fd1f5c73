"""Training: reinforcement by Stable-Baselines3, imitation of scripted policies, datasets. It makes checkpoints."""
