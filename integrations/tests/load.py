"""Load a dataset with LeRobot, and compare it with what this package reads: load.py DATASET."""

from __future__ import annotations

import sys

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from dual_ur10.lerobot.dataset_reader import read_dataset


def main(folder: str) -> None:
    """Compare every tenth frame bit for bit, and load all batches with chunks of actions."""
    expected = read_dataset(folder)
    found = LeRobotDataset("local/dataset", root=folder, video_backend="pyav")
    for row in range(0, len(found), 10):
        frame = found[row]
        for name in ("action", "env_action", "observation.state"):
            if name in expected.columns:
                assert np.array_equal(frame[name].numpy(), expected.columns[name][row]), (row, name)
    chunks = {"action": [k / found.fps for k in range(10)]}
    loader = torch.utils.data.DataLoader(
        LeRobotDataset("local/dataset", root=folder, video_backend="pyav", delta_timestamps=chunks), batch_size=32
    )
    batches = sum(1 for _ in loader)
    about = f"{len(found)} frames of {found.num_episodes} episodes are equal, {batches} batches"
    print(f"{folder}: {about}, task {frame['task']!r}")


if __name__ == "__main__":
    main(*sys.argv[1:])
