"""Packets that emulated controllers received, counted in their control periods, and their limits."""

import math

import numpy as np

from ur_core.kinematics.ur10 import HARD_SPEED_RAD_S

SERVOJ = 11  # ur_rtde's number of the command
STOP_RAD_S2, STOP_RAD_S3 = 4.0, 200.0  # of a stop, by docs/explanation/safety.md
RAMP_TICKS = 3  # more than v/a + a/j
_OVER = 5  # packages over which a speed is taken: delayed ones may arrive two in one control period
_SLOWEST = 1 / 8  # time scaling near things, by the same page
_BETWEEN = 1.05  # of a limit; docs/explanation/safety.md


class ViolationError(AssertionError):
    """Forbidden packet to an arm. Such a test is never repeated."""


def demand(holds, text):
    """Raise unless this holds."""
    if not holds:
        raise ViolationError(text)


def ramp_ticks(speed_rad_s, tick_s):
    """Return the control periods of a stop ramp from this speed."""
    return math.ceil((speed_rad_s / STOP_RAD_S2 + STOP_RAD_S2 / STOP_RAD_S3) / tick_s) + RAMP_TICKS


def derivative(period, target_rad, order, tick_s):
    """Return divided differences of targets, (k, 6), whatever periods were skipped."""
    time_s, level = period * tick_s, target_rad
    for each in range(1, order + 1):
        level = each * np.diff(level, axis=0) / (time_s[each:] - time_s[:-each])[:, None]
    return level


def _from_slowing(noted, order, tick_s):
    """Return the acceleration and jerk, (k, 6), of a time scaling that falls, which comes on top of the path's."""
    period, index, target_rad = noted[:, 0], noted[:, 1], noted[:, 2:]
    if order < 2:
        return 0.0
    rate = np.diff(index) / np.diff(period)
    falls = np.maximum(rate[:-1] - rate[1:], 0.0)[:, None] / tick_s
    speed = np.abs(derivative(period, target_rad, 1, tick_s)) / np.maximum(rate, _SLOWEST)[:, None]
    extra = falls * np.maximum(speed[:-1], speed[1:])
    return extra if order == 2 else (extra[:-1] + extra[1:]) / tick_s


class Wire:
    """Packets that one controller received since `begin`, and its sender's log.

    Args:
        cell: The emulated cell.
        arm: Its name.
    """

    def __init__(self, cell, arm):
        self._cell, self.arm = cell, arm
        self.begin()

    def begin(self):
        """Count from here on."""
        found = self.received()
        self._first, self._next, self.uploads_before = found["motion"], found["motion"], found["uploads"]
        self._packages, self._noted, self._noted_next, self.memory = [], [], 0, None

    def received(self):
        """Return the controller's counters."""
        return self._cell.ask("received", arm=self.arm, since=1 << 40)

    @property
    def uploads(self):
        """Uploaded programs."""
        return self.received()["uploads"] - self.uploads_before

    def collect(self):
        """Collect new packets."""
        self.note()
        self._packages += self._cell.packages(self.arm, self._next)
        self._next = self._first + len(self._packages)

    def note(self):
        """Collect the sender's log before it is overwritten."""
        if self.memory is not None and self.memory.sent_count > self._noted_next:  # it is all zeros when it was closed
            sent, count = self.memory.sent(self._noted_next)
            new = count - self._noted_next
            assert len(sent.period) == new, f"of {new} targets {len(sent.period)} are remembered: collect more often"
            self._noted.append(np.column_stack([sent.period, sent.index, sent.target_rad]))
            self._noted_next = count

    def packages(self):
        """Return the control periods of packets, (k,), and their targets, (k, 6)."""
        self.collect()
        others = {command for _, command, _ in self._packages} - {SERVOJ}
        demand(not others, f"{self.arm}: motion commands {sorted(others)} were sent, and not servoj alone")
        ticks = np.array([tick for tick, _, _ in self._packages])
        return ticks, np.array([numbers for _, _, numbers in self._packages]).reshape(-1, 6)

    def speeds_rad_s(self, tick_s):
        """Return the speed of the fastest joint over some packets each, (k,), up to that packet."""
        ticks, targets = self.packages()
        if len(ticks) <= _OVER:
            return np.zeros(len(ticks))
        over = np.maximum(ticks[_OVER:] - ticks[:-_OVER], _OVER)
        speeds = np.abs(targets[_OVER:] - targets[:-_OVER]).max(axis=1) / (over * tick_s)
        return np.concatenate([np.zeros(_OVER), speeds])

    def assert_hard_limits(self, tick_s):
        """Check packets against the hard limits of an arm's process."""
        ticks, targets = self.packages()
        demand(np.isfinite(targets).all(), f"{self.arm}: a target is not finite")
        over = np.maximum(ticks[_OVER:] - ticks[:-_OVER], _OVER) + 1
        used = np.abs(targets[_OVER:] - targets[:-_OVER]) / (over[:, None] * tick_s * HARD_SPEED_RAD_S)
        demand(used.max(initial=0.0) <= 1.0, f"{self.arm}: {used.max(initial=0.0):.3f} of the hardest speed")

    def assert_limits(self, limits, tick_s, executed):
        """Check speed, acceleration and jerk of all packets against the limits.

        What came must be all that the sender has noted, in order, to the last bit, and in the noted control periods.
        What was executed must be what came, in order.
        """
        self.collect()
        noted = np.concatenate(self._noted) if self._noted else np.zeros((0, 8))
        count = self.arrived(noted)
        ticks, targets = self.packages()
        ticks, came, period = ticks[:count], targets[:count], noted[:count, 0]
        same = (came == noted[:count, 2:]).all(axis=1)
        demand(same.all(), f"{self.arm}: target {int(same.argmin())} that came is not the one that was noted")
        demand((np.diff(period) >= 1).all(), f"{self.arm}: two targets for one control period")
        # Between two targets, under clock drift or time scaling, packets lie on a cubic through them.
        between = np.abs(noted[:count, 1] - np.rint(noted[:count, 1])).max(initial=0.0) > 1e-9
        allowed = _BETWEEN if between else 1.0 + 1e-6
        for order, (name, limit) in enumerate(
            (
                ("speed", limits.speed_rad_s),
                ("acceleration", limits.acceleration_rad_s2),
                ("jerk", limits.jerk_rad_s3),
            ),
            start=1,
        ):
            found = np.abs(derivative(period, came, order, tick_s)) - _from_slowing(noted[:count], order, tick_s)
            used = found / limit
            most = float(used.max(initial=0.0))
            demand(most <= allowed, f"{self.arm}: {most:.4f} of the greatest {name} at {int(used.max(1).argmax())}")
        place = 0
        known = [row.tobytes() for row in targets]
        for row in executed:
            data = row.tobytes()
            while place < len(known) and known[place] != data:
                place += 1
            demand(
                place < len(known), f"{self.arm}: {row.tolist()} was executed, and did not come, or not in this order"
            )
        self.assert_in_step(ticks - period, tick_s)
        return count

    def arrived(self, noted):
        """Return the number of noted targets that must have come: all."""
        demand(len(self.packages()[0]) == len(noted), f"{self.arm}: not all of {len(noted)} sent targets came")
        return len(noted)

    def assert_in_step(self, offset, tick_s):
        """Check that all targets came in the control periods for which they were sent."""
        demand(len(set(offset.tolist())) <= 1, f"{self.arm}: targets came {sorted(set(offset.tolist()))} periods off")

    def assert_rested(self, tick, tick_s):
        """Check that the packets from a control period on stopped the arm."""
        ticks, targets = self.packages()
        begin = int(np.searchsorted(ticks, tick))
        before = float(self.speeds_rad_s(tick_s)[max(begin - 1, 0) : begin + 1].max(initial=0.0))
        assert len(ticks) >= 2
        last = float(np.abs(targets[-1] - targets[-2]).max()) / (max(ticks[-1] - ticks[-2], 1) * tick_s)
        assert last <= 0.25 * before + 0.01, (
            f"{self.arm}: {last:.3f} rad/s was left of {before:.3f} rad/s when targets ended: no ramp"
        )
