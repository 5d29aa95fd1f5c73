"""Hash of a seeded rollout, by id and MuJoCo's minor version. See CONTRIBUTING.md before changing one."""

HASHES: dict[tuple[str, str], str] = {
    ("DualUR10/SineTracking-v0", "3.17"): "a0f3a5039b37e307",
    ("DualUR10/SineTracking-v0", "4.0"): "a0f3a5039b37e307",
    ("DualUR10/SyncCarry-v0", "3.17"): "b10b2f13811ad073",
    ("DualUR10/SyncCarry-v0", "4.0"): "b10b2f13811ad073",
    ("DualUR10/Handover-v0", "3.17"): "43b6e3d3115da361",
    ("DualUR10/Handover-v0", "4.0"): "43b6e3d3115da361",
}
