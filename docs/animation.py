"""Draw docs/images/tasks.gif, the three tasks side by side: python docs/animation.py (needs the extra `plot`)."""

from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image

from dual_ur10.policies import load

SIZE, FRAMES, FRAME_S = (296, 222), 60, 0.1
TASKS = {"SineTracking": 8.0, "SyncCarry": 36.0, "Handover": 12.0}
"""Simulated seconds of each task; all are shown in the same time."""


def frames(task: str, seconds: float) -> list[np.ndarray]:
    """Return images of one episode of the scripted policy, evenly spaced in time."""
    env_id = f"DualUR10/{task}-v0"
    env = gym.make(env_id, render_mode="rgb_array", width=2 * SIZE[0], height=2 * SIZE[1])
    policy = load("scripted", env_id)
    observation, _ = env.reset(seed=1)
    policy.reset()
    images, over = [], False
    for step in range(int(seconds * 25)):
        if step * FRAMES >= len(images) * seconds * 25:
            images.append(np.asarray(Image.fromarray(env.render()).resize(SIZE, Image.Resampling.LANCZOS)))
        if not over:
            observation, _, terminated, truncated, _ = env.step(policy(observation))
            over = terminated or truncated
    env.close()
    return images


if __name__ == "__main__":
    columns = [frames(task, seconds) for task, seconds in TASKS.items()]
    rows = [Image.fromarray(np.hstack(images)) for images in zip(*columns, strict=True)]
    palette = rows[len(rows) // 2].quantize(96, method=Image.Quantize.MEDIANCUT)
    pictures = [row.quantize(palette=palette, dither=Image.Dither.NONE) for row in rows]
    path = Path(__file__).parent / "images" / "tasks.gif"
    duration_ms = int(1000 * FRAME_S)
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=duration_ms, loop=0, optimize=True)
    print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB, {len(rows)} frames")
