"""Hash of a seeded rollout, by id and MuJoCo's minor version. See CONTRIBUTING.md before changing one."""

HASHES: dict[tuple[str, str], str] = {
    ("DualUR10/SineTracking-v0", "3.17"): "21c10d49b0ea5664",
    ("DualUR10/SineTracking-v0", "4.0"): "21c10d49b0ea5664",
    ("DualUR10/SyncCarry-v0", "3.17"): "6c1c0a42f405285b",
    ("DualUR10/SyncCarry-v0", "4.0"): "6c1c0a42f405285b",
    ("DualUR10/Handover-v0", "3.17"): "5432224a1e67fb70",
    ("DualUR10/Handover-v0", "4.0"): "5432224a1e67fb70",
    ("DualUR10/Free-v0", "3.17"): "7afa3be63e38b0ac",
    ("DualUR10/Free-v0", "4.0"): "7afa3be63e38b0ac",
}
