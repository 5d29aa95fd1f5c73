"""Make an untrained ACT policy of LeRobot for a dataset: make_policy.py DATASET FOLDER."""

from __future__ import annotations

import sys
from pathlib import Path

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors


def main(dataset: str, folder: str) -> None:
    """Save a policy of the smallest size, which takes images if the dataset has any, and else states alone."""
    known = LeRobotDataset("local/dataset", root=dataset)
    kinds = {"observation.state": FeatureType.STATE}
    images = [name for name in known.features if name.startswith("observation.images.")]
    kinds |= dict.fromkeys(images, FeatureType.VISUAL) or {"observation.environment_state": FeatureType.ENV}
    inputs = {}
    for name, kind in kinds.items():
        shape = tuple(known.features[name]["shape"])
        inputs[name] = PolicyFeature(kind, (shape[2], *shape[:2]) if kind is FeatureType.VISUAL else shape)
    config = ACTConfig(
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, tuple(known.features["action"]["shape"]))},
        dim_model=32,
        dim_feedforward=64,
        n_heads=2,
        n_encoder_layers=1,
        use_vae=False,
        chunk_size=25,
        n_action_steps=25,
        pretrained_backbone_weights=None,
        device="cpu",
        push_to_hub=False,
    )
    ACTPolicy(config).save_pretrained(folder)
    for each in make_pre_post_processors(config, dataset_stats=known.meta.stats):
        each.save_pretrained(folder)
    print(f"{folder}: {', '.join(sorted(path.name for path in Path(folder).iterdir()))}")


if __name__ == "__main__":
    main(*sys.argv[1:])
