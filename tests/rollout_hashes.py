"""Hash of a seeded rollout, by id and MuJoCo's minor version. See CONTRIBUTING.md before changing one."""

HASHES: dict[tuple[str, str], str] = {
    ("DualUR10/SineTracking-v0", "3.17"): "f1e6227f79340925",
    ("DualUR10/SineTracking-v0", "4.0"): "f1e6227f79340925",
}
