"""Environments on two emulated controllers in real time: one episode, Ctrl-C, and the garbage collector."""

import gc
import os
import signal
import threading
import time
import weakref

import numpy as np
import pytest

from tests.live.faults.lab import Lab, assert_gone, descendants
from tests.parity import handed_over
from tests.virtual.faults.lab import Swing

pytestmark = pytest.mark.streams


@pytest.fixture(scope="module")
def the_lab(tmp_path_factory):
    made = Lab(tmp_path_factory.mktemp("cell"), task="Handover")
    yield made
    made.close()


@pytest.fixture
def lab(the_lab):
    text = the_lab.path.read_text()
    yield the_lab
    the_lab.path.write_text(text)
    the_lab.mend()


def test_one_policy_hands_over_on_both_cells_with_a_record(lab, tmp_path):
    found, late, run = handed_over(lab, tmp_path)
    assert found.success or late, found.ended_by
    for arm in run.arms:
        assert np.unique(np.diff(arm.state["timestamp_s"]).round(4)).tolist() == [0.008]
        assert len(arm.sent["late_s"]) > 4.8 * found.steps  # late targets are skipped


def test_the_collector_ignores_objects_from_before_the_episode(lab, monkeypatch):
    env = lab.make()
    made = gc.get_freeze_count()
    assert made > 10_000
    kept = [[] for _ in range(10_000)]

    def collect(*_):
        raise AssertionError("a collection stops the threads that hear grippers and cameras")

    with monkeypatch.context() as patch:
        patch.setattr(gc, "collect", collect)
        env.reset(seed=0)
    frozen = gc.get_freeze_count()
    assert frozen >= made + len(kept)
    episode = Swing(1)
    episode.itself, left = episode, weakref.ref(episode)
    for _ in range(2):
        env.reset(seed=0, options={"move_to_start": True})
        episode = None
    assert left() is None
    assert gc.get_freeze_count() <= frozen
    lab.close_env()
    assert gc.get_freeze_count() == 0


@pytest.mark.parametrize("after_s", [0.1, 0.5, 0.9])
def test_a_make_interrupted_twice_leaves_nothing_behind(lab, after_s):
    def interrupt():
        for pause_s in (after_s, 0.1):
            time.sleep(pause_s)
            os.kill(os.getpid(), signal.SIGINT)

    before = set(descendants(os.getpid()))
    heard = []
    thread = threading.Thread(target=interrupt)
    for work in (lambda: (thread.start(), lab.make(), time.sleep(30.0)), thread.join):
        try:
            work()
        except KeyboardInterrupt as error:
            heard.append(error)
    thread.join()
    assert heard
    heard.clear()  # with them goes what they hold
    assert_gone(set(descendants(os.getpid())) - before)
    lab.make()  # the lock is free


def test_ctrl_c_reports_that_both_arms_are_at_rest(lab):
    process = lab.program("rollout", "SineTracking", "-n", "1", "--no-record")
    lab.wait_until_moving(process)
    process.send_signal(signal.SIGINT)
    assert process.wait(30.0) == 130
    assert process.stdout.read().splitlines()[-1] == "interrupted: both arms have stopped"
    lab.assert_at_rest()
