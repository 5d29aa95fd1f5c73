"""Hash of a seeded rollout, by id and MuJoCo's minor version. See CONTRIBUTING.md before changing one."""

HASHES: dict[tuple[str, str], str] = {
    ("DualUR10/SineTracking-v0", "3.17"): "f1e6227f79340925",
    ("DualUR10/SineTracking-v0", "4.0"): "f1e6227f79340925",
    ("DualUR10/SyncCarry-v0", "3.17"): "f84f955bc85bfce1",
    ("DualUR10/SyncCarry-v0", "4.0"): "f84f955bc85bfce1",
    ("DualUR10/Handover-v0", "3.17"): "85df4697d10fa1e1",
    ("DualUR10/Handover-v0", "4.0"): "85df4697d10fa1e1",
}
