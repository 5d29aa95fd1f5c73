"""Load a checkpoint of ACT with LeRobot, and compare its chunks with those of this package: load_policy.py FOLDER."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import torch
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

from dual_ur10.lerobot.features import ENVIRONMENT_STATE, STATE
from dual_ur10.lerobot.positions import Positions
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.signature import view_of_signature


def main(folder: str) -> None:
    """Compare chunks for random observations within the bounds of the environment."""
    ours: Any = checkpoint.load(folder)
    theirs = ACTPolicy.from_pretrained(folder)
    before, after = make_pre_post_processors(theirs.config, pretrained_path=folder)
    signature = ours.manifest.signature
    positions, rng = Positions(view_of_signature(signature)), np.random.default_rng(0)
    seen = ours.manifest.normalisers[1]
    usual = np.minimum(np.sqrt(seen.var), 1.0)  # unseen fields have huge variances
    largest = 0.0
    for _ in range(20):
        observation = np.array(seen.mean) + usual * rng.normal(size=len(seen.mean))
        given = {STATE: positions.state(observation[None])[0], ENVIRONMENT_STATE: observation.astype(np.float32)}
        batch = before({name: torch.from_numpy(each) for name, each in given.items()})
        found = after(theirs.predict_action_chunk(batch)).numpy()[0].astype(np.float64)
        if signature.actions.gripper:
            found[:, 6::7] = 2.0 * found[:, 6::7] - 1.0
        largest = max(largest, float(np.abs(found - ours.chunk(observation, 0.0)).max()))
    if not largest < 1e-4:
        raise SystemExit(f"{folder}: chunks differ by {largest:g}")
    print(f"{folder}: 20 chunks of LeRobot are those of dual_ur10, but for {largest:.1e}")


if __name__ == "__main__":
    main(*sys.argv[1:])
