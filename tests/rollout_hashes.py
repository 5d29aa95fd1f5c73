"""Hash of a seeded rollout, by id and MuJoCo's minor version. See CONTRIBUTING.md before changing one."""

HASHES: dict[tuple[str, str], str] = {
    ("DualUR10/SineTracking-v0", "3.17"): "21c10d49b0ea5664",
    ("DualUR10/SineTracking-v0", "4.0"): "21c10d49b0ea5664",
    ("DualUR10/SyncCarry-v0", "3.17"): "16769cc9d1bded0c",
    ("DualUR10/SyncCarry-v0", "4.0"): "16769cc9d1bded0c",
    ("DualUR10/Handover-v0", "3.17"): "b9162da37950f094",
    ("DualUR10/Handover-v0", "4.0"): "b9162da37950f094",
}
