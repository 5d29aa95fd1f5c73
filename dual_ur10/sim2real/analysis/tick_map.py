"""Map from the numbers of targets to ticks of the task's clock.

The map is the same for both arms. Where an action missed its deadline, both arms stop: the numbers of targets go on,
while the task's clock advances by one action. All later targets therefore have other numbers than without the stop.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.recording.run import LATE, Run
from ur_core.types import Array, Mask

_NEAR: Final = 25  # ticks by which a target may be sent before the beginning of its episode
_ROUNDING: Final = 1e-9


@dataclass(frozen=True)
class _TargetStretch:
    """Targets without a stop between them.

    Attributes:
        begin: Number of the first target that belongs to an action.
        end: Number after the last.
        offset: Number of a target minus its tick of the task.
    """

    begin: float
    end: float
    offset: float


@dataclass(frozen=True)
class TickMap:
    """Map from target numbers to ticks of the task in one episode.

    Attributes:
        stretches: One or more, in order.
        first: Number of the target of tick 0.
        end: Number after the episode's last target.
        stopped_until: Number up to which both arms stand, because the first action missed its deadline.
    """

    stretches: tuple[_TargetStretch, ...]
    first: float
    end: float
    stopped_until: float = -np.inf

    def __call__(self, number: Array) -> tuple[Array, Mask]:
        """Return the ticks of the task, (k,), and the mask of targets between two stretches, where both arms stop."""
        begins = np.array([each.begin for each in self.stretches])
        where = np.maximum(np.searchsorted(begins, number + _ROUNDING, side="right") - 1, 0)
        ticks, stopped = np.empty(len(number)), number < self.stopped_until
        for k, each in enumerate(self.stretches):
            inside = where == k
            here = number[inside]
            ticks[inside] = here - each.offset
            if k + 1 < len(self.stretches):
                after = self.stretches[k + 1]
                passed = (each.end - each.offset, after.begin - after.offset)
                paused = np.interp(here, (each.end, after.begin), passed)
                stopped[inside] |= here > each.end - 1.0 + _ROUNDING
                ticks[inside] = np.where(here > each.end, paused, ticks[inside])
            elif each.end < self.end:
                stopped[inside] = here > each.end - 1.0 + _ROUNDING
        return ticks, stopped


def tick_map(run: Run, number: int) -> TickMap:
    """Return the map of an episode.

    Raises:
        RecordingError: None of its targets was sent.
    """
    episode, latency_ticks = run.episodes[number], run.header.latency_ticks
    steps, ticks = episode.targets_rad.shape[:2]
    firsts = episode.first_target
    stretches: list[_TargetStretch] = []
    for step in np.flatnonzero(firsts >= 0).tolist():
        begin = float(firsts[step])
        offset = begin - step * ticks - latency_ticks
        if stretches and stretches[-1].offset == offset:
            stretches[-1] = _TargetStretch(stretches[-1].begin, begin + ticks, offset)
        else:
            stretches.append(_TargetStretch(begin, begin + ticks, offset))
    if not stretches:
        raise RecordingError(
            f"0 targets of an action were sent in episode {number}: it has no step, or every action missed its "
            "deadline. Compare another episode, or another recording"
        )
    last = stretches[-1]
    end = last.end if firsts[-1] == LATE else last.offset + steps * ticks
    stopped_until = stretches[0].begin if firsts[0] == LATE else -np.inf
    return TickMap(tuple(stretches), stretches[0].offset, end, stopped_until)


def late_actions(run: Run, numbers: Iterable[int]) -> int:
    """Return the number of actions of some episodes that missed their deadline."""
    return sum(int((run.episodes[number].first_target == LATE).sum()) for number in numbers)


def sent_around(run: Run, number: int, arm: int) -> Mask:
    """Return the mask of the targets sent to an arm that may belong to an episode, by their time."""
    episode, tick_s = run.episodes[number], run.header.tick_s
    later = [each.begin_s for each in run.episodes if each.begin_s > episode.begin_s]
    sent_s = run.arms[arm].sent["sent_s"]
    result: Mask = (sent_s >= episode.begin_s - _NEAR * tick_s) & (sent_s < min(later, default=np.inf) - tick_s / 2)
    return result
