"""Hashes of seeded rollouts, by name and MuJoCo's minor version. See CONTRIBUTING.md before changing one.

What changes a hash changes results, and needs a new id. MuJoCo promises equal results only for one version on one
architecture, so other versions are only checked against themselves. Names are ids of environments, a handover on two
emulated controllers with a virtual clock, and emulated arms by themselves.
"""

import hashlib
from collections.abc import Callable

import mujoco
import numpy as np

DIGITS = 6  # processors round differently, by up to 2e-11, and contacts amplify it

ROBOTS = ("ur3", "ur5e", "ur10", "ur16e", "ur30")
PLANTS = ("nominal", "wide")

HASHES: dict[tuple[str, str], str] = {
    ("DualUR10/SineTracking-v0", "3.17"): "21c10d49b0ea5664",
    ("DualUR10/SineTracking-v0", "4.0"): "21c10d49b0ea5664",
    ("DualUR10/SyncCarry-v0", "3.17"): "6c1c0a42f405285b",
    ("DualUR10/SyncCarry-v0", "4.0"): "6c1c0a42f405285b",
    ("DualUR10/Handover-v0", "3.17"): "5432224a1e67fb70",
    ("DualUR10/Handover-v0", "4.0"): "5432224a1e67fb70",
    ("DualUR10/Free-v0", "3.17"): "7afa3be63e38b0ac",
    ("DualUR10/Free-v0", "4.0"): "7afa3be63e38b0ac",
    ("DualUR10/PegInsertion-v0", "3.17"): "5e9a2651b1179cb8",
    ("DualUR10/PegInsertion-v0", "4.0"): "5e9a2651b1179cb8",
    ("DualUR10/TrayBalance-v0", "3.17"): "ba3af381706e00f7",
    ("DualUR10/TrayBalance-v0", "4.0"): "ba3af381706e00f7",
    ("DualUR10/BoxLift-v0", "3.17"): "67298fde315427df",
    ("DualUR10/BoxLift-v0", "4.0"): "67298fde315427df",
    ("DualUR10/LidAndPlace-v0", "3.17"): "a3685a32f75b491f",
    ("DualUR10/LidAndPlace-v0", "4.0"): "a3685a32f75b491f",
    ("ur3, nominal", "3.17"): "decfe51d007e0229",
    ("ur3, nominal", "4.0"): "decfe51d007e0229",
    ("ur3, wide", "3.17"): "ac987e712b4f2be1",
    ("ur3, wide", "4.0"): "ac987e712b4f2be1",
    ("ur5e, nominal", "3.17"): "6d8875e8e4c9f903",
    ("ur5e, nominal", "4.0"): "6d8875e8e4c9f903",
    ("ur5e, wide", "3.17"): "7191ef00576cd1e7",
    ("ur5e, wide", "4.0"): "7191ef00576cd1e7",
    ("ur10, nominal", "3.17"): "2e0f8841a30c2ca0",
    ("ur10, nominal", "4.0"): "2e0f8841a30c2ca0",
    ("ur10, wide", "3.17"): "6ca0fdb0bddc3482",
    ("ur10, wide", "4.0"): "6ca0fdb0bddc3482",
    ("ur16e, nominal", "3.17"): "8a53e8fcbb4c04a4",
    ("ur16e, nominal", "4.0"): "8a53e8fcbb4c04a4",
    ("ur16e, wide", "3.17"): "0710c373435514c1",
    ("ur16e, wide", "4.0"): "0710c373435514c1",
    ("ur30, nominal", "3.17"): "c7f117743cf4d903",
    ("ur30, nominal", "4.0"): "c7f117743cf4d903",
    ("ur30, wide", "3.17"): "49b51373a04c358a",
    ("ur30, wide", "4.0"): "49b51373a04c358a",
    ("virtual handover", "3.17"): "96fcd08b2165dd77",
    ("virtual handover", "4.0"): "96fcd08b2165dd77",
}


def digest(*arrays: object) -> str:
    """Return the hash of arrays that are rounded to `DIGITS`."""
    found = hashlib.sha256()
    for each in arrays:
        found.update((np.round(np.asarray(each, dtype=np.float64), DIGITS) + 0.0).tobytes())
    return found.hexdigest()[:16]


def check(name: str, measure: Callable[[], str]) -> None:
    """Compare a hash with the recorded one; with a MuJoCo that has none, with another run."""
    version = ".".join(mujoco.__version__.split(".")[:2])
    found = measure()
    if (name, version) in HASHES:
        assert found == HASHES[name, version]
    else:
        assert version not in {known for _, known in HASHES}, f"{name} has no hash for MuJoCo {version}"
        assert found == measure()
