"""Stop of one arm under a clock of the test."""

from __future__ import annotations

import types

import numpy as np
import pytest

from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.arm_sender import ArmSender
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from ur_core.servoj import ServojProfile

PROFILES = {"cb3": ServojProfile("cb3", 0.03, 2000.0), "e-series": ServojProfile("e-series", 0.03, 2000.0)}
SPEED_RAD_S = 0.5
STOPPING_RAD = SPEED_RAD_S**2 / 8 + 0.004  # v² / 2a and what the jerk adds
SENT = 50


class Time:
    """Clock that advances only by waiting."""

    def __init__(self):
        self.now = 100.0

    def now_s(self):
        return self.now

    def sleep(self, seconds):
        self.now += max(0.0, seconds)

    def wait(self, readers, until_s, writers=()):
        self.sleep(until_s - self.now)
        return [], []


class Silent:
    """Link and control interface that accepts everything."""

    def __init__(self, time, hiccup_s=0.0):
        self.time, self.hiccup_s, self.targets = time, hiccup_s, []

    def fileno(self):
        return 0

    def poll(self):
        return []

    def isConnected(self):
        return True

    def servoJ(self, q, *_):
        self.targets.append(np.array(q))
        if len(self.targets) == SENT + 5:
            self.time.sleep(self.hiccup_s)
        return True

    def servoStop(self, a):
        return True

    def stopScript(self):
        return None


@pytest.fixture
def memory():
    memory, cell = ArmMemory(), CellMemory()
    yield memory, cell
    memory.close()
    cell.close()


def stopped(parts, family, gap_s, hiccup_s=0.0):
    """Send an arm along a line, delay and stop it; return the targets sent then and their periods."""
    memory, cell = parts
    clock, servoj = Time(), PROFILES[family]
    ends = Silent(clock, hiccup_s)
    sender = ArmSender(
        "left", servoj, ends, ends, memory, cell, robot="ur10", system=types.SimpleNamespace(clock=clock)
    )
    for packet in range(40):
        sender.clock.note(5.0 + servoj.tick_s * packet, clock.now + servoj.tick_s * packet)
    clock.sleep(servoj.tick_s * 40)
    steps = np.minimum(np.arange(600) / (SENT - 20), 1.0) * SPEED_RAD_S * servoj.tick_s
    line = HOME_Q_RAD[0] + np.cumsum(steps)[:, None] * np.eye(6)[0]
    memory.put(0, line)
    sender._measured_rad = line[0]
    first, due = sender.clock.next_period(clock.now, 0.5)
    for k in range(SENT):
        clock.sleep(due + k * servoj.tick_s - clock.now)
        sender._send(line[k], first + k, float(k))
    clock.sleep(gap_s)
    begun = clock.now
    sender._stop("a reason", on_path=True)
    return np.array(ends.targets[SENT - 1 :]), round((clock.now - begun) / servoj.tick_s), memory


@pytest.mark.parametrize(
    ("family", "gap_s"), [("cb3", 0.002), ("cb3", 0.015), ("e-series", 0.001), ("e-series", 0.015)]
)
def test_an_arm_with_missed_periods_still_stops_on_its_path(memory, family, gap_s):
    sent, _, memory = stopped(memory, family, gap_s)
    way = sent[-1][0] - sent[0][0]
    assert way == pytest.approx(STOPPING_RAD, abs=0.004)
    steps = np.diff(sent[1:, 0]) / PROFILES[family].tick_s
    assert (np.diff(steps) < 1e-9).all()
    assert steps[-1] < 0.05
    assert memory.phase == Phase.STOPPED
    assert memory.text == "left: a reason"


@pytest.mark.parametrize("family", list(PROFILES))
def test_a_delayed_ramp_skips_missed_periods(memory, family):
    sent, periods, memory = stopped(memory, family, 0.001, hiccup_s=0.02)
    assert memory.text == "left: a reason"
    assert len(sent) < periods  # those of the hiccup were left out
    assert sent[-1][0] - sent[0][0] == pytest.approx(STOPPING_RAD, abs=0.004)


@pytest.mark.parametrize("family", list(PROFILES))
def test_an_arm_at_its_last_target_is_sent_nothing_more(memory, family):
    sent, _, memory = stopped(memory, family, 0.05)
    assert len(sent) == 1
    assert memory.phase == Phase.STOPPED
    assert "a reason; sent nothing for 5" in memory.text
    assert "stopped at its last target" in memory.text
