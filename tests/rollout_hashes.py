"""Hash of a seeded rollout, by id and MuJoCo's minor version. See CONTRIBUTING.md before changing one."""

HASHES: dict[tuple[str, str], str] = {
    ("DualUR10/SineTracking-v0", "3.17"): "3d8daf7956348ac6",
    ("DualUR10/SineTracking-v0", "4.0"): "3d8daf7956348ac6",
    ("DualUR10/SyncCarry-v0", "3.17"): "f546e5ad943a84d4",
    ("DualUR10/SyncCarry-v0", "4.0"): "f546e5ad943a84d4",
    ("DualUR10/Handover-v0", "3.17"): "115301c3a7a03dee",
    ("DualUR10/Handover-v0", "4.0"): "115301c3a7a03dee",
}
