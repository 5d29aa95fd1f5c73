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
from dual_ur10.policies.learned.lerobot_files import image_key
from dual_ur10.policies.learned.signature import view_of_signature


def main(folder: str) -> None:
    """Compare chunks for random observations within the bounds of the environment."""
    ours: Any = checkpoint.load(folder)
    theirs = ACTPolicy.from_pretrained(folder, strict=True)
    before, after = make_pre_post_processors(theirs.config, pretrained_path=folder)
    signature = ours.manifest.signature
    positions, rng = Positions(view_of_signature(signature)), np.random.default_rng(0)
    shape, pictures, largest = ours.manifest.network, {}, 0.0
    for _ in range(20):
        observation = _random(ours.manifest, rng)
        given = {STATE: positions.state(observation[None])[0]}
        if not shape.cameras:
            given[ENVIRONMENT_STATE] = observation.astype(np.float32)
        for camera in shape.cameras:
            pictures[camera] = rng.integers(0, 256, (shape.height, shape.width, 3)).astype(np.uint8)
            given[image_key(camera)] = pictures[camera].transpose(2, 0, 1).astype(np.float32) / 255
        seen = {"state": observation, "pixels": pictures} if pictures else observation
        batch = before({name: torch.from_numpy(each) for name, each in given.items()})
        found = after(theirs.predict_action_chunk(batch)).numpy()[0].astype(np.float64)
        if signature.actions.gripper:
            found[:, 6::7] = 2.0 * found[:, 6::7] - 1.0
        largest = max(largest, float(np.abs(found - ours.chunk(seen, 0.0)).max()))
    if not largest < 1e-4:
        raise SystemExit(f"{folder}: chunks differ by {largest:g}")
    print(f"{folder}: 20 chunks of LeRobot are those of dual_ur10, but for {largest:.1e}")


def _random(manifest: Any, rng: np.random.Generator) -> Any:
    """Return the numbers of an observation, as usual as those of the training."""
    shape, sizes = manifest.network, manifest.normalisers
    found = np.zeros(manifest.signature.observation.shape[0])
    places = [list(shape.state), list(range(len(found)))][len(shape.inputs) - 1]
    seen = sizes[len(shape.inputs) - 1]
    usual = np.minimum(np.sqrt(seen.var), 1.0)  # unseen fields have huge variances
    found[places] = np.array(seen.mean) + usual * rng.normal(size=len(places))
    return found


if __name__ == "__main__":
    main(*sys.argv[1:])
