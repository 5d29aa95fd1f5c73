"""Time scaling and latching by the supervisor."""

from __future__ import annotations

import os
import threading
import time
import types

import pytest

from dual_ur10.assets.settings import SceneSettings
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.control.time_scaling import TimeScaling
from dual_ur10.sim2real.runtime import stop_enforcer
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory, Phase
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from dual_ur10.sim2real.runtime.latch import Latch
from dual_ur10.sim2real.runtime.safety_monitor import MonitorSettings
from dual_ur10.sim2real.runtime.stop_enforcer import STOPPED_S, StopEnforcer
from dual_ur10.sim2real.runtime.supervisor import Supervisor
from tests.ur_emulator.statuses import status_of

TEXT = 'kind = "emulated"\n[left]\nhost = "127.0.0.2"\n[right]\nhost = "127.0.0.3"\n'


@pytest.fixture
def parts(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    path = tmp_path / "lab.toml"
    path.write_text(TEXT)
    arms, cell = [ArmMemory(), ArmMemory()], CellMemory()
    yield load_cell_file(path), arms, cell
    for each in (*arms, cell):
        each.close()


def supervisor(parts, tick_s=0.008):
    file, arms, cell = parts
    return Supervisor(file, MonitorSettings(SceneSettings().mounts, tick_s), arms, cell, os.getpid())


@pytest.mark.parametrize("tick_s", [0.008, 0.002])
@pytest.mark.parametrize("late_s", [0.0, 0.05])
def test_a_new_scaling_begins_in_the_future(parts, monkeypatch, tick_s, late_s):
    cell, made = parts[2], supervisor(parts, tick_s)
    cell.set_time_scaling(TimeScaling(0.0, 0.0, 1.0, 1.0))
    cell.begin(time.monotonic() - 2.0)
    for arm in (0, 1):
        made._monitor.note(arm, status_of(target_speed_fraction=0.5, speed_scaling=1.0))
    set_time_scaling = cell.set_time_scaling

    def slowly(scaling):
        ahead.append(scaling.period * tick_s - (time.monotonic() - cell.begin_s))
        time.sleep(late_s)
        set_time_scaling(scaling)

    ahead = []
    monkeypatch.setattr(cell, "set_time_scaling", slowly)
    reason = made._scale_time()
    assert len(ahead) == 1
    if late_s:
        assert "stalled while it changed the time scaling" in reason
    else:
        assert reason is None or "stalled" in reason  # this machine may do so, too
        assert cell.time_scaling.goal == 0.5
        assert made._scale_time() is None


@pytest.mark.parametrize(
    ("slider", "most", "goal"), [(1.0, 0.25, 0.25), (0.5, 0.75, 0.5), (0.5, 0.125, 0.125), (0.0, 0.125, 0.0)]
)
def test_the_slower_of_sliders_and_distances_counts(parts, caplog, slider, most, goal):
    cell, made = parts[2], supervisor(parts)
    assert cell.largest_scaling == 1.0
    cell.set_time_scaling(TimeScaling())
    cell.limit_scaling(most)
    cell.begin(time.monotonic() - 2.0)
    for arm in (0, 1):
        made._monitor.note(arm, status_of(target_speed_fraction=slider, speed_scaling=1.0))
    reason = made._scale_time()
    assert reason is None or "stalled" in reason  # this machine may do so
    assert cell.time_scaling.goal == goal
    assert [each.getMessage() for each in caplog.records] == (
        [] if slider == 1.0 or reason else [f"both arms continue at {100 * slider:.0f} % of their speed"]
    )


def test_a_new_scaling_waits_for_the_beginning_of_the_last_one(parts):
    cell, made = parts[2], supervisor(parts)
    cell.begin(time.monotonic() - 2.0)
    begun = TimeScaling().towards(0.5, 2.0 / 0.008 + 1e6, 0.008)  # in more than two hours
    cell.set_time_scaling(begun)
    cell.limit_scaling(0.25)
    assert made._scale_time() is None
    assert cell.time_scaling.goal == 0.25  # it begins with that one
    assert cell.time_scaling.period == begun.period
    changing = TimeScaling().towards(0.5, 2.0 / 0.008 + 1.0, 0.008)
    cell.set_time_scaling(changing)
    assert made._scale_time() is None
    assert cell.time_scaling == changing


class Dashboard:
    """Stub that records requests."""

    asked = 0

    def __init__(self, *_, **__):
        pass

    def stop(self):
        Dashboard.asked += 1


def test_a_program_that_outlives_its_process_is_a_fault(parts, monkeypatch):
    """It was paused after the last target of the ramp: nothing else would show it."""
    monkeypatch.setattr(stop_enforcer, "DashboardLink", Dashboard)
    monkeypatch.setattr(stop_enforcer, "STOPPED_S", 0.05)
    file, arms, cell = parts
    made = supervisor(parts)
    made._enforcer = StopEnforcer(arms, ["127.0.0.2", "127.0.0.3"])
    cell.begin(time.monotonic())
    for arm, memory in enumerate(arms):
        memory.enter(Phase.STOPPED, "a stop was requested")
        made._monitor.note(arm, status_of(runtime_state=1 if arm == 0 else 4))
    made._end()
    assert Dashboard.asked == 1
    assert "right: its program had not ended after 0.05 s" in Latch(file).read().text
    assert STOPPED_S > 0.65  # the longest ramp


@pytest.mark.parametrize("deaf", [False, True])
def test_a_controller_that_takes_no_targets_is_stopped_at_once(parts, monkeypatch, deaf):
    monkeypatch.setattr(stop_enforcer, "DashboardLink", Dashboard)
    monkeypatch.setattr(Dashboard, "asked", 0)
    enforcer = StopEnforcer(parts[1], ["127.0.0.2", "127.0.0.3"])
    for memory in parts[1]:
        memory.enter(Phase.STOPPING, "left: it does not follow")
    if deaf:
        parts[1][0].note_deaf()
    enforcer.begin()
    for _ in range(2):
        enforcer.poll([False, False])
    enforcer.close()
    assert Dashboard.asked == deaf
    assert enforcer.waits  # for the processes of both


@pytest.mark.parametrize("begun", [False, True])
@pytest.mark.parametrize("ready", [False, True])
def test_a_failed_start_is_not_latched(parts, begun, ready):
    file, _, cell = parts
    made = supervisor(parts)
    made._enforcer = types.SimpleNamespace(
        begin=lambda: None, poll=lambda ended: None, waits=False, close=lambda: None, unended=[]
    )
    made._ready = ready
    if begun:
        cell.begin(time.monotonic())
    made._stop("right: takes no control script")
    assert (Latch(file).read() is not None) == (begun or ready)
    assert cell.fault == "right: takes no control script"


def test_a_slow_disk_does_not_delay_the_end_of_a_process_that_hangs(parts, monkeypatch):
    enforced, found = threading.Event(), []
    monkeypatch.setattr(Latch, "set", lambda self, text: found.append((text, enforced.wait(10.0))))
    made = supervisor(parts)
    made._enforcer = types.SimpleNamespace(
        begin=lambda: None, poll=lambda ended: enforced.set(), waits=False, close=lambda: None, unended=[]
    )
    parts[2].begin(time.monotonic())
    made._stop("left: a reason")
    assert found == [("left: a reason", True)]


def test_a_stop_that_cannot_be_latched_is_logged(parts, monkeypatch, caplog):
    def full(self, text):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Latch, "set", full)
    made = supervisor(parts)
    made._enforcer = types.SimpleNamespace(
        begin=lambda: None, poll=lambda ended: None, waits=False, close=lambda: None, unended=[]
    )
    parts[2].begin(time.monotonic())
    made._stop("left: a reason")
    assert "cannot be latched: [Errno 28]" in caplog.text
    assert "both arms were stopped: left: a reason" in caplog.text
