"""Faults of whoever watches over the arms in the live page."""

import pytest

from dual_ur10.envs.rendering.live import attendance
from dual_ur10.envs.rendering.live.attendance import Attendance
from dual_ur10.envs.rendering.live.commander import Commander
from dual_ur10.envs.rendering.live.memory import LiveMemory
from dual_ur10.errors import CellFaulted
from ur_core.objects import load_object

UNATTENDED_S = 1.0  # instead of 3 s
MOST_S = UNATTENDED_S + 0.3


class Pages:
    """Open pages, and a policy that moves both arms meanwhile."""

    def __init__(self, lab, required=True):
        self.lab, self.memory = lab, LiveMemory(1, 0)
        self.cell = lab.env.unwrapped.core.cell
        path, *names = self.cell.live_view
        self.view = load_object(path, "a view", registered=True)(*names)
        self.attendance = Attendance(self.memory, lab.clock, required=required)
        self.commander = Commander(self.memory, lab.clock, asks=True)

    def step(self, for_s):
        """Let the policy act for a while; return the stop that it meets, and after how long."""
        begun_s = self.lab.clock.now_s()
        try:
            while self.lab.clock.now_s() < begun_s + for_s:
                self.attendance.poll(self.view)
                if self.cell.runner.cell.fault:
                    self.lab.note()
                self.lab.env.step(self.lab.policy())
        except CellFaulted as error:
            return error, self.lab.clock.now_s() - begun_s
        return None, for_s

    def close(self):
        self.view.close()
        self.memory.close()


@pytest.fixture
def pages(lab, monkeypatch):
    monkeypatch.setattr(attendance, "UNATTENDED_S", UNATTENDED_S)
    lab.begin(steps=2)
    made = Pages(lab)
    yield made
    made.close()


def test_64_both_arms_stop_once_everybody_has_closed_the_page(lab, pages):
    pages.commander.enter(1)
    assert pages.step(MOST_S)[0] is None
    pages.commander.leave(1)
    assert pages.step(UNATTENDED_S / 2)[0] is None
    pages.commander.enter(2)  # the page was reloaded
    assert pages.step(MOST_S)[0] is None
    pages.commander.leave(2)
    error, after_s = pages.step(MOST_S)
    assert UNATTENDED_S < after_s < MOST_S
    lab.assert_stopped(error, "no live page has been open for 3 s")


def test_64_arms_at_rest_and_arms_that_may_be_unattended_have_no_stop(lab, pages):
    assert not pages.memory.pages
    lab.env.unwrapped.core.cell.finish()  # the episode is over
    for _ in range(2):
        lab.clock.sleep(MOST_S)
        pages.attendance.poll(pages.view)
    assert not pages.cell.runner.cell.fault
    lab.reset(seed=0)
    allowed = Pages(lab, required=False)
    assert allowed.step(MOST_S)[0] is None
    allowed.close()
