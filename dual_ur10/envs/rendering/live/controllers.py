"""Words of a live page on a cell of two controllers."""

from __future__ import annotations

from dual_ur10.envs.rendering.live.history import Sending
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.cell_memory import CellMemory


class Controllers:
    """Supervisor, latch and streams of a cell of controllers, from its memories."""

    def __init__(self, names: tuple[str, str, str]) -> None:
        self.cell = CellMemory(names[2])
        self.arms = ArmMemory(names[0]), ArmMemory(names[1])
        self.sending = Sending(self.arms)

    @property
    def owe_motion(self) -> bool:
        """True during an episode, and on the way to its start."""
        return self.cell.live and not self.cell.ending

    def words(self, now_s: float) -> dict[str, str]:
        """Return the lines of the page."""
        cell = self.cell
        age_s = now_s - cell.supervisor_beat_s
        if not cell.ready:
            supervisor = "starts"
        elif age_s < 1.0:
            supervisor = f"watches both arms, time scaling {100 * cell.time_scaling.goal:.0f} %"
        elif cell.fault:
            supervisor = "ended with the stop"
        else:
            supervisor = f"no sign of life for {age_s:.1f} s"
        found = {"supervisor": supervisor, "latch": f"LATCHED: {cell.fault}" if cell.fault else "open, arms may move"}
        for name, memory in zip(ARMS, self.arms, strict=True):
            text = memory.text if memory.phase >= Phase.STOPPING else ""
            found[f"{name} stream"] = f"{memory.phase.name.lower()}{': ' if text else ''}{text}"
        return found

    def close(self) -> None:
        """Release the memories."""
        for each in (self.cell, *self.arms):
            each.close()
