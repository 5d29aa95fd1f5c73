"""Hash of a seeded rollout, by id and MuJoCo's minor version. See CONTRIBUTING.md before changing one."""

HASHES: dict[tuple[str, str], str] = {
    ("DualUR10/SineTracking-v0", "3.17"): "5c1ac67c98b65868",
    ("DualUR10/SineTracking-v0", "4.0"): "5c1ac67c98b65868",
    ("DualUR10/SyncCarry-v0", "3.17"): "a9efc7b19d0c6592",
    ("DualUR10/SyncCarry-v0", "4.0"): "a9efc7b19d0c6592",
    ("DualUR10/Handover-v0", "3.17"): "4d55c9f66d7e31c8",
    ("DualUR10/Handover-v0", "4.0"): "4d55c9f66d7e31c8",
}
