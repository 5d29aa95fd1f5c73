"""Hash of a seeded rollout, by id and MuJoCo's minor version. See CONTRIBUTING.md before changing one."""

HASHES: dict[tuple[str, str], str] = {
    ("DualUR10/SineTracking-v0", "3.17"): "3cb808a2d99c5737",
    ("DualUR10/SineTracking-v0", "4.0"): "3cb808a2d99c5737",
    ("DualUR10/SyncCarry-v0", "3.17"): "47214a59f848b17b",
    ("DualUR10/SyncCarry-v0", "4.0"): "47214a59f848b17b",
    ("DualUR10/Handover-v0", "3.17"): "db2945928deb66ad",
    ("DualUR10/Handover-v0", "4.0"): "db2945928deb66ad",
}
