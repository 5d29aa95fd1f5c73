"""Emulated cells that several tests share."""

from ur_emulator.profile import PROFILES

SERIAL_NUMBERS = {"cb3": "2010300002", "e-series": "2021500002"}
"""Serial numbers of right arms: emulated controllers of a family have the same one."""


def restored(cell):
    """Return the cell in order, whatever a test before has changed."""
    profile = PROFILES[cell.description["left"]["family"]]
    shown = {name: getattr(profile, name) for name in ("version", "model", "robot_type", "safety_checksum")}
    cell.ask("pretend", arm="left", **shown)
    cell.ask("pretend", arm="right", serial_number=SERIAL_NUMBERS[profile.family])
    cell.ask("override", arm="left", **dict.fromkeys(cell.ask("state", arm="left")))
    cell.ask("heal", arm="left")
    cell.ask("slider", arm="left", fraction=1.0)
    cell.ask("remote", arm="left", on=True)
    cell.ask("calibration", arm="left", error_m=0.0)
    return cell
