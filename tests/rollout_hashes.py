"""Hash of a seeded rollout, by id and MuJoCo's minor version. See CONTRIBUTING.md before changing one."""

HASHES: dict[tuple[str, str], str] = {
    ("DualUR10/SineTracking-v0", "3.17"): "cd2831bfcb30379a",
    ("DualUR10/SineTracking-v0", "4.0"): "cd2831bfcb30379a",
    ("DualUR10/SyncCarry-v0", "3.17"): "a7e6ff3036ac939e",
    ("DualUR10/SyncCarry-v0", "4.0"): "a7e6ff3036ac939e",
    ("DualUR10/Handover-v0", "3.17"): "32423f21127d7b6f",
    ("DualUR10/Handover-v0", "4.0"): "32423f21127d7b6f",
}
