"""Memory shared with an arm's process."""

import subprocess
import sys
import time

import numpy as np
import pytest

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.arm_memory import RING, ArmMemory, Phase


@pytest.fixture
def pair():
    mine = ArmMemory()
    theirs = ArmMemory(mine.name)
    yield mine, theirs
    theirs.close()
    mine.close()


def test_targets_arrive_in_order_beyond_the_end_of_the_ring(pair):
    mine, theirs = pair
    targets = np.random.default_rng(0).uniform(-3, 3, (3 * RING, 6))
    sent = 0
    for begin in range(0, len(targets), 100):
        mine.put(targets[begin : begin + 100])
        while sent < theirs.written:
            np.testing.assert_array_equal(theirs.target(sent), targets[sent])
            theirs.note_sent(sent, 100.0 + sent, 0.001 * sent)
            sent += 1
    assert mine.sent == mine.written == len(targets)
    at, late = mine.timing()
    assert len(at) == RING
    np.testing.assert_array_equal(at, 100.0 + np.arange(len(targets) - RING, len(targets)))
    np.testing.assert_allclose(late, 0.001 * np.arange(len(targets) - RING, len(targets)))


def test_targets_that_were_not_sent_are_not_overwritten(pair):
    mine, theirs = pair
    mine.put(np.zeros((RING, 6)))
    with pytest.raises(SettingsError, match="do not fit"):
        mine.put(np.ones((1, 6)))
    theirs.note_sent(0, 1.0, 0.0)
    mine.put(np.ones((1, 6)))
    np.testing.assert_array_equal(theirs.target(RING), np.ones(6))


def test_phases_go_up_only_and_keep_their_reason(pair):
    mine, theirs = pair
    assert mine.phase == Phase.STARTING
    theirs.enter(Phase.READY)
    theirs.enter(Phase.STOPPING, "left: größer als erlaubt" + "x" * 5000)
    theirs.enter(Phase.STREAMING, "and on")
    assert mine.phase == Phase.STOPPING
    assert mine.text.startswith("left: größer als erlaubt")
    assert len(mine.text) < 1024


def test_a_beginning_and_a_stop_are_told(pair):
    mine, theirs = pair
    assert theirs.begin_s is None
    assert not theirs.stop_asked
    mine.begin(12.5)
    mine.stop()
    assert theirs.begin_s == 12.5
    assert theirs.stop_asked


def test_what_was_skipped_is_counted(pair):
    mine, theirs = pair
    theirs.note_skipped(3)
    theirs.note_skipped(2)
    assert mine.skipped == 5


def test_memory_that_is_closed_is_gone():
    memory = ArmMemory()
    name = memory.name
    memory.close()
    memory.close()
    with pytest.raises(FileNotFoundError):
        ArmMemory(name)


def test_nothing_is_left_when_a_program_ends_without_closing():
    code = (
        "from dual_ur10.sim2real.arm_memory import ArmMemory\n"
        "memory = ArmMemory()\nprint(memory.name, flush=True)\nimport os\nos._exit(0)\n"
    )
    name = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    for _ in range(50):  # Python's tracker of such memory takes a moment
        try:
            ArmMemory(name).close()
        except FileNotFoundError:
            return
        time.sleep(0.1)
    pytest.fail("the memory is still there")
