"""Which tick of the task's clock a target belongs to: by the numbers of targets, the same for both arms.

Where an action came too late, both arms come to rest and the numbers of targets go on, while one action's time passes
for the task. Whatever follows has other numbers than it would have had.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.sim2real.recording.run import LATE, ArmLog, Episode, Header, Run
from dual_ur10.types import Array

_NEAR: Final = 25  # ticks by which the beginning of an episode may be off the target that it is found by
_UNLIKE_RAD: Final = 5e-3  # targets farther apart have nothing to do with each other
_ROUNDING: Final = 1e-9


@dataclass(frozen=True)
class _Stretch:
    """Targets without a rest between them.

    Attributes:
        begin: Number of the first that an action was for.
        end: Number behind the last.
        offset: What its numbers are above the ticks of the task.
    """

    begin: float
    end: float
    offset: float


@dataclass(frozen=True)
class Numbering:
    """Target numbers of one episode.

    Attributes:
        stretches: In order, one or more.
        first: Number of the target of tick 0.
        behind: Number behind the episode's last target.
        rested: Both arms rest up to this number, because the first action came too late.
    """

    stretches: tuple[_Stretch, ...]
    first: float
    behind: float
    rested: float = -np.inf

    def __call__(self, number: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Ticks of the task, (k,), and which of them lie between two stretches, where both arms came to rest."""
        begins = np.array([each.begin for each in self.stretches])
        where = np.maximum(np.searchsorted(begins, number + _ROUNDING, side="right") - 1, 0)
        ticks, resting = np.empty(len(number)), number < self.rested
        for k, each in enumerate(self.stretches):
            inside = where == k
            here = number[inside]
            ticks[inside] = here - each.offset
            if k + 1 < len(self.stretches):
                after = self.stretches[k + 1]
                passed = (each.end - each.offset, after.begin - after.offset)
                paused = np.interp(here, (each.end, after.begin), passed)
                braking = here > each.end - 1.0 + _ROUNDING
                resting[inside] |= braking
                ticks[inside] = np.where(here > each.end, paused, ticks[inside])
            elif each.end < self.behind:
                resting[inside] = here > each.end - 1.0 + _ROUNDING
        return ticks, resting


def numbering(run: Run, number: int) -> Numbering:
    """That of an episode: as it was recorded, or else found by what was let out and what was sent."""
    episode, header = run.episodes[number], run.header
    steps, ticks = episode.targets_rad.shape[:2]
    told = episode.first_target
    if told is None or not (told >= 0).any():
        first = _found(run.arms, episode, header)
        return Numbering((_Stretch(first, first + steps * ticks, first),), first, first + steps * ticks)
    stretches: list[_Stretch] = []
    for step in np.flatnonzero(told >= 0).tolist():
        begin = float(told[step])
        offset = begin - step * ticks - header.latency_ticks
        if stretches and stretches[-1].offset == offset:
            stretches[-1] = _Stretch(stretches[-1].begin, begin + ticks, offset)
        else:
            stretches.append(_Stretch(begin, begin + ticks, offset))
    last = stretches[-1]
    behind = last.end if told[-1] == LATE else last.offset + steps * ticks
    rested = stretches[0].begin if told[0] == LATE else -np.inf
    return Numbering(tuple(stretches), stretches[0].offset, behind, rested)


def rests(run: Run) -> int:
    """How many actions came too late, as far as it was recorded."""
    return sum(int((each.first_target == LATE).sum()) for each in run.episodes if each.first_target is not None)


def around(run: Run, number: int, arm: int) -> NDArray[np.bool_]:
    """Which of the targets that were sent to an arm may belong to an episode, by their time."""
    episode, tick_s = run.episodes[number], run.header.tick_s
    later = [each.begin_s for each in run.episodes if each.begin_s > episode.begin_s]
    sent_s = run.arms[arm].sent["sent_s"]
    result: NDArray[np.bool_] = (sent_s >= episode.begin_s - _NEAR * tick_s) & (
        sent_s < min(later, default=np.inf) - tick_s / 2
    )
    return result


def _found(arms: Sequence[ArmLog], episode: Episode, header: Header) -> float:
    """Number of an episode's first target: that near its beginning with which what was sent is what was let out.

    For recordings that do not tell it. One number for both arms, that with which both together fit best; what was sent
    after a rest fits none, and counts for none.
    """
    begin_s, tick_s = episode.begin_s, header.tick_s
    near: float | None = None
    for each in arms:
        sent_s = each.sent["sent_s"]
        if near is None and len(sent_s):
            near = float(np.rint(each.sent["index"][np.abs(sent_s - begin_s).argmin()]))
    if near is None:
        return 0.0
    best, found = np.inf, near
    for away in sorted(range(-_NEAR, _NEAR + 1), key=abs):
        miss, count = 0.0, 0
        for arm, each in enumerate(arms):
            out = episode.targets_rad[:, :, arm].reshape(-1, 6)
            rows = each.sent["sent_s"] >= begin_s - _NEAR * tick_s
            place = each.sent["index"][rows] - (near + away) - header.latency_ticks
            inside = (place >= 0) & (place <= len(out) - 1)
            difference = each.sent["target_rad"][rows][inside] - out[place[inside].astype(int)]
            square = (difference * difference).mean(axis=1)
            miss, count = miss + float(np.minimum(square, _UNLIKE_RAD**2).sum()), count + len(square)
        if count and miss / count < best * (1 - 1e-9):
            best, found = miss / count, near + away
    return found
