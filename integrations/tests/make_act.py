"""Save an untrained ACT of this package, without PyTorch: make_act.py FOLDER."""

from __future__ import annotations

import sys
from pathlib import Path

from dual_ur10.policies.learned import checkpoint

sys.path.append(str(Path(__file__).parents[2]))

from tests.policies.learned.acts import act_parts


def main(folder: str) -> None:
    """Save a checkpoint of Handover whose weights are random and whose chunks are joint positions."""
    checkpoint.save(folder, *act_parts("DualUR10/Handover-v0"))


if __name__ == "__main__":
    main(*sys.argv[1:])
