"""Cell of two controllers as a live page shows and stops it, from its memories."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dual_ur10.sim2real.cameras.camera_memory import newest_images, opened
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from ur_core.kinematics.ur10 import ARMS


class LiveView:
    """Supervisor, latch and streams of a cell; a `dual_ur10.envs.rendering.live.arms_view.ArmsView`.

    Args:
        left: Name of the memory of the left arm.
        right: Name of that of the right arm.
        cell: Name of that of the cell.
        cameras: Observed cameras, as `CameraSet.memories` has them.
    """

    def __init__(self, left: str, right: str, cell: str, *cameras: str) -> None:
        self._cameras = opened(cameras)
        self._cell = CellMemory(cell)
        self._arms = ArmMemory(left), ArmMemory(right)
        self._seen = [memory.sent_count for memory in self._arms]
        self._unmatched: list[dict[int, float]] = [{}, {}]

    @property
    def owe_motion(self) -> bool:
        """True during an episode, and on the way to its start."""
        return self._cell.live and not self._cell.ending

    def stop(self, reason: str) -> None:
        """Latch a stop of both arms."""
        self._cell.enter_fault(reason)

    def words(self, now_s: float) -> dict[str, str]:
        """Return the lines of the page."""
        cell = self._cell
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
        for name, memory in zip(ARMS, self._arms, strict=True):
            text = memory.text if memory.phase >= Phase.STOPPING else ""
            found[f"{name} stream"] = f"{memory.phase.name.lower()}{': ' if text else ''}{text}"
        return found

    def sending(self) -> tuple[float, float]:
        """Return the largest delay of a target, and the largest skew of both arms' targets, since the last call.

        Both in ms; NaN: nothing was sent.
        """
        late = math.nan
        for arm, memory in enumerate(self._arms):
            sent, self._seen[arm] = memory.sent(self._seen[arm])
            if len(sent.late_s):
                late = float(np.fmax(late, 1e3 * sent.late_s.max()))
            self._unmatched[arm].update(zip(sent.period.astype(int).tolist(), sent.sent_s.tolist(), strict=True))
        left, right = self._unmatched
        both = left.keys() & right.keys()
        skew = max((1e3 * abs(left[each] - right[each]) for each in both), default=math.nan)
        newest = max((*both, -1))
        self._unmatched = [{period: at for period, at in each.items() if period > newest} for each in (left, right)]
        return late, skew

    def images(self, now_s: float) -> dict[str, NDArray[np.uint8]]:
        """Return the newest image of each observed camera, by its name; none of one that has sent none."""
        return newest_images(self._cameras, now_s)

    def close(self) -> None:
        """Release the memories."""
        self._cell.close()
        for arm in self._arms:
            arm.close()
        for camera in self._cameras.values():
            camera.close()
