"""Invariants of the targets of an episode: released, in time, within limits, and ended by a ramp."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dual_ur10.sim2real.runtime.arm_memory import Phase
from tests.virtual.observer import Episode
from tests.virtual.schedule import Schedule
from ur_core.kinematics.ur10 import ARMS, HARD_ACCELERATION_RAD_S2, HARD_SPEED_RAD_S, JOINT_RANGE_RAD, TICK_S

if TYPE_CHECKING:
    from tests.virtual.simulation import Run

SERVOJ: Final = 11
STOP_S: Final = 0.9
"""Longest time from the first note of a stop to the last target: the ramp from the largest speed, 0.65 s, and spare."""

_TOLERANCE: Final = 1.0 + 1e-6


class TargetChecks:
    """Invariants of one runner's targets."""

    def __init__(self, run: Run, episode: Episode, number: int) -> None:
        self.run, self.episode, self.number = run, episode, number
        self.demand = run.demand
        self.cell = run.schedule.cell
        self.tick_s = TICK_S[self.cell.family]
        self.faults = run.schedule.faults

    def all(self) -> None:
        """Check them all."""
        if not any(self.episode.sent):
            return
        self._gate()
        for arm in range(2):
            self._wire(arm)
            self._path(arm)
            self._limits(arm)
            self._ends(arm)
        self._together()

    def _packages(self, arm: int) -> list[Any]:
        received = self.run.observer.controller(arm).received
        first = received.motion_count - len(received.motion)
        begin = self.episode.wire[arm]
        following = self.run.observer.episodes[self.number + 1 :]
        end = following[0].wire[arm] if following else received.motion_count
        return list(received.motion)[begin - first : end - first]

    def _wire(self, arm: int) -> None:
        name, received = ARMS[arm], self.run.observer.controller(arm).received
        packages = self._packages(arm)
        self.demand(all(each[1] == SERVOJ for each in packages), f"{name}: other commands than servoj were sent")
        targets = np.array([each[2] for each in packages]).reshape(-1, 6)
        self.demand(bool(np.isfinite(targets).all()), f"{name}: a target is not finite")
        self.demand(bool((np.abs(targets) <= JOINT_RANGE_RAD).all()), f"{name}: a target is out of range")
        self.demand(received.uploads <= self.run.starts, f"{name}: {received.uploads} programs were uploaded")
        if packages:
            watchdog = received.watchdog
            self.demand(
                watchdog is not None and (self.number > 0 or watchdog[0] <= packages[0][0]),
                f"{name}: it moved before its watchdog was armed: {watchdog}",
            )
            self.demand(watchdog is not None and watchdog[1:] == (10.0, "stop"), f"{name}: its watchdog is {watchdog}")
        noted = [each[4].tobytes() for each in self.episode.sent[arm]]
        came = [np.array(each[2]).tobytes() for each in packages]
        lost = len(noted) - len(came)
        self.demand(came == noted[: len(came)], f"{name}: a target that came is not the one that was sent")
        shaky = any(
            each.kind in ("link", "drop", "death") or (each.kind == "stall" and "contro" in each.process)
            for each in self.faults
        )
        if not shaky:
            self.demand(lost <= 1, f"{name}: {lost} targets were lost")
            ticks = np.diff([each[0] for each in packages])
            # A stop of the program ends the reading of targets, which then come together.
            self.demand(bool((ticks >= 1).all()), f"{name}: two targets came in one control period")

    def _gate(self) -> None:
        """Check that what is written for the arms was released, or is the brake after it, within the limits."""
        episode, released = self.episode, self.run.observer.released
        path: dict[int, np.ndarray] = {}
        for number, (_, first, targets) in enumerate(episode.puts):
            if number == 0:
                path[0] = targets[0].reshape(12)
                continue
            rows = targets.reshape(-1, 12)
            self.demand(rows[0].tobytes() in released, f"target {first} was written without being released")
            begin = min(first, max(path) + 1)
            before = [path[max(0, min(n, max(path)))] for n in range(begin - 3, begin)]
            gap = [path[max(path)]] * max(0, first - max(path) - 1)
            whole = np.array([*before, *gap, *rows])
            if episode.limits is not None and len(rows) > 1:
                self._within(whole, episode.limits, f"written from {first} on")
            for offset, row in enumerate(rows):
                path[first + offset] = row
            for stale in [each for each in path if each >= first + len(rows)]:
                del path[stale]
            for n in range(begin, first):
                path.setdefault(n, before[-1])

    def _within(self, rows: np.ndarray, limits: Any, what: str) -> None:
        level = rows
        for name, limit in (
            ("speed", limits.speed_rad_s),
            ("acceleration", limits.acceleration_rad_s2),
            ("jerk", limits.jerk_rad_s3),
        ):
            level = np.diff(level, axis=0) / self.tick_s
            used = float((np.abs(level) / np.tile(np.broadcast_to(limit, 6), 2)).max(initial=0.0))
            # Rounding of a third difference.
            self.demand(used <= 1.0 + 1e-4, f"{used:.4f} of the largest {name} {what}")

    def _path(self, arm: int) -> None:
        """Check that targets lie on the released path, in time and in order."""
        name, episode = ARMS[arm], self.episode
        puts = iter(episode.puts)
        following = next(puts, None)
        path: list[np.ndarray] = []
        last_index, slow = -1.0, episode.slowed
        straight = any("a target is" in text for _, _, text in episode.phases[arm])
        for at_s, _, index, late_s, target, stopping in episode.sent[arm]:
            while following is not None and following[0] <= at_s:
                _, first, rows = following
                if first > len(path):
                    path += [path[-1]] * (first - len(path))
                path[first:] = list(rows[:, arm])
                following = next(puts, None)
            if not (stopping and straight):
                off = float(np.abs(_at(path, index) - target).max())
                self.demand(off < 1e-12, f"{name}: target {index:.3f} is {off:.6f} rad off the released path")
            self.demand(index >= last_index - 1e-9, f"{name}: target {index:.3f} was sent after {last_index:.3f}")
            last_index = max(index, last_index)
            self.demand(late_s <= 0.1 + 1e-6 or stopping, f"{name}: a target was sent {1e3 * late_s:.0f} ms late")
            due = (at_s - episode.begin_s) / self.tick_s * self.cell.speed_factor
            self.demand(index <= due + 2.5, f"{name}: target {index:.2f} was sent at {due:.2f}, too early")
            if not stopping and not slow:
                behind = 0.1 / self.tick_s + 4
                self.demand(index >= due - behind, f"{name}: target {index:.2f} was sent at {due:.2f}: an old one")

    def _limits(self, arm: int) -> None:
        """Check the targets sent against the hard limits."""
        name, sent = ARMS[arm], self.episode.sent[arm]
        period = np.array([each[1] for each in sent], dtype=float)
        target = np.array([each[4] for each in sent]).reshape(-1, 6)
        stopping = np.array([each[5] for each in sent])
        if len(sent) < 3:
            return
        self.demand(bool((np.diff(period) >= 1).all()), f"{name}: two targets are for one control period")
        steps = np.maximum(np.diff(period), 1.0)
        speed = np.diff(target, axis=0) / (steps * self.tick_s)[:, None]
        used = float((np.abs(speed) / HARD_SPEED_RAD_S).max())
        self.demand(used <= _TOLERANCE, f"{name}: {used:.3f} of the hard speed was sent")
        between = (steps[1:] + steps[:-1]) / 2 * self.tick_s
        change = np.abs(np.diff(speed, axis=0)) / between[:, None]
        slow = self.episode.slowed
        allowed = HARD_ACCELERATION_RAD_S2 * 1.05 + (4.0 * np.abs(speed[1:]) if slow else 0.0)
        # The ramp of a stop adds its own deceleration and curvature.
        allowed = np.where(stopping[2:, None], allowed + 2 * HARD_ACCELERATION_RAD_S2, allowed)
        if self.cell.speed_factor == 1.0 or not slow:
            most = float((change / allowed).max())
            self.demand(most <= _TOLERANCE, f"{name}: {most:.3f} of the largest acceleration was sent")
        self.demand(
            float(change.max()) <= 3.0 * HARD_ACCELERATION_RAD_S2 * 1.05, f"{name}: {change.max():.1f} rad/s² was sent"
        )

    def _ends(self, arm: int) -> None:
        """Check that targets end soon after the first note of a stop, and with a ramp."""
        name, episode = ARMS[arm], self.episode
        last_s = episode.sent[arm][-1][0] if episode.sent[arm] else -math.inf
        most_s = STOP_S + slack_s(self.run.schedule)
        self.demand(
            last_s <= episode.known_s + most_s,
            f"{name}: a target was sent {last_s - episode.known_s:.3f} s after the stop",
        )
        other = [at for at, phase, _ in episode.phases[1 - arm] if phase >= Phase.STOPPING]
        streaming = [each[0] for each in episode.sent[arm] if not each[5]]
        if other and streaming:
            late_s = streaming[-1] - other[0]
            own = any(each.kind == "stall" for each in self.faults)
            self.demand(
                late_s <= 3 * self.tick_s or own,
                f"{name}: it was led on for {late_s:.3f} s after the other arm stopped",
            )

        texts = [text for _, phase, text in episode.phases[arm] if phase == Phase.STOPPED]
        led = texts and not any("sent nothing" in each or "no longer took" in each for each in texts)
        shaky = any(each.kind in ("stall", "link") for each in self.faults)
        moving = [each for each in episode.sent[arm] if not each[5]]
        if led and not shaky and len(moving) > 1:
            before, after = _step(moving), _step(episode.sent[arm])
            self.demand(
                after <= 0.25 * before + 0.01 * self.tick_s,
                f"{name}: targets ended at {after / self.tick_s:.3f} of {before / self.tick_s:.3f} rad/s: no ramp",
            )

        gentle = all(each.kind in ("slider", "second", "policy", "wall_clock", "disk") for each in self.faults)
        # A slow slider lengthens the controller's own stop, in which nobody feeds the watchdog.
        slow = any(
            each.kind == "slider"
            and each.fraction < 0.5
            and (not each.duration_s or self.run.injector.fired.get(n, 0.0) + each.duration_s > episode.ending_s)
            for n, each in enumerate(self.faults)
        )
        if led and gentle and not slow and episode is self.run.observer.episodes[-1]:
            why = self.run.observer.controller(arm).program.stopped_by
            self.demand("watchdog" not in why, f"{name}: its watchdog ended its program")

    def _together(self) -> None:
        """Check that two arms that can both be led to rest stop at one place of their path."""
        episode = self.episode
        if any(each.kind in ("stall", "link") for each in self.faults):
            return
        ended = [[text for _, phase, text in arm if phase == Phase.STOPPED] for arm in episode.phases]
        texts = [text for arm in ended for text in arm]
        if len(texts) < 2 or any("sent nothing" in each or "no longer took" in each for each in texts):
            return
        if any("a target is" in text for arm in episode.phases for _, _, text in arm):
            return
        stopping = [sum(each[5] for each in sent) for sent in episode.sent]
        if min(stopping) == 0:
            return
        last = [sent[-1][2] for sent in episode.sent]
        apart_s = abs(last[0] - last[1]) * self.tick_s
        self.demand(apart_s <= 0.04, f"the arms stopped {1e3 * apart_s:.0f} ms of their path apart")


def slack_s(schedule: Schedule) -> float:
    """Return the time by which the schedule's own stalls and delays may lengthen a stop."""
    total = 0.0
    for fault in schedule.faults:
        if fault.kind == "stall":
            total += fault.duration_s
        elif fault.kind == "link":
            total += 2 * fault.amount if fault.effect in ("delay_s", "jitter_s") else 0.0
            total += fault.duration_s
    return total


def _step(sent: list[Any]) -> float:
    """Return the largest joint's last step, rad per control period."""
    return float(np.abs(sent[-1][4] - sent[-2][4]).max()) / max(sent[-1][1] - sent[-2][1], 1)


def _at(path: list[np.ndarray], index: float) -> np.ndarray:
    """Return the path at a fractional number."""
    index = max(index, 0.0)
    below, last = int(index), len(path) - 1
    if index == below or below >= last:
        return path[min(below, last)]
    # Hermite's cubic whose slopes are those between neighbours; not the function under test.
    t = index - below
    before, start, stop, after = (path[min(max(n, 0), last)] for n in range(below - 1, below + 3))
    basis = (2 * t**3 - 3 * t**2 + 1, t**3 - 2 * t**2 + t, 3 * t**2 - 2 * t**3, t**3 - t**2)
    return basis[0] * start + basis[1] * (stop - before) / 2 + basis[2] * stop + basis[3] * (after - start) / 2
