"""Memory shared with an arm's process: targets, packets, states and phases."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.runtime.arm_memory import RING, ArmMemory, Phase
from tests.ur_emulator.statuses import status_of
from ur_core.processes.shared_memory import SharedBlock


@pytest.fixture
def pair():
    mine = ArmMemory()
    theirs = ArmMemory(mine.name)
    yield mine, theirs
    theirs.close()
    mine.close()


def rows(first, count):
    """Return targets that identify themselves."""
    return np.arange(first, first + count)[:, None] + np.arange(6) / 10


# Targets.


def test_targets_arrive_bit_for_bit_beyond_the_end_of_the_ring(pair):
    mine, theirs = pair
    targets = np.random.default_rng(0).uniform(-3, 3, (3 * RING, 6))
    for first in range(0, len(targets), 100):
        block = targets[first : first + 100]
        mine.put(first, block)
        assert theirs.end == mine.end == first + len(block)
        for number, target in enumerate(block, start=first):
            assert (theirs.target(number) == target).all()
            assert (theirs.target(float(number)) == target).all()


def test_future_targets_are_overwritten(pair):
    mine, theirs = pair
    mine.put(0, rows(0, 50))  # a motion, and the brake behind it
    mine.put(10, rows(100, 5))  # overwrites the brake
    assert theirs.end == 15
    np.testing.assert_array_equal(theirs.target(9), rows(9, 1)[0])
    np.testing.assert_array_equal(theirs.target(10), rows(100, 1)[0])
    for beyond in (14, 15, 14.5, 40, 1e9):
        np.testing.assert_array_equal(theirs.target(beyond), rows(104, 1)[0])


@pytest.mark.parametrize("gap", [1, 7, RING // 2, RING, 3 * RING + 5])
def test_an_arm_rests_at_the_last_target_until_the_next_ones(pair, gap):
    mine, theirs = pair
    half = RING // 2
    mine.put(0, rows(0, half))
    mine.put(half, rows(half, half - 3))
    last = rows(RING - 4, 1)[0]
    mine.put(RING - 3 + gap, rows(5000, 2))
    for back in range(1, min(gap, half) + 1):
        np.testing.assert_array_equal(theirs.target(RING - 3 + gap - back), last)
    np.testing.assert_array_equal(theirs.target(RING - 3 + gap), rows(5000, 1)[0])


@pytest.mark.parametrize("gap", [1, RING - 1, RING, RING + 1])
def test_an_arm_at_rest_sees_no_target_before_its_time(pair, gap):
    mine, theirs = pair
    mine.put(0, rows(0, 10))
    first, targets = 10 + gap, mine._targets

    class Watched:
        """Looks, as the other process may, after every write."""

        def __getitem__(self, key):
            return targets[key]

        def __setitem__(self, key, value):
            targets[key] = value
            np.testing.assert_array_equal(theirs.target(first - 1), rows(9, 1)[0])

    mine._targets = Watched()
    mine.put(first, rows(100, 20))
    mine._targets = targets
    np.testing.assert_array_equal(theirs.target(first), rows(100, 1)[0])


def test_a_target_overwritten_during_a_read_is_read_again(pair, monkeypatch):
    """The reader was suspended between the number of the last target and the target."""
    mine, theirs = pair
    mine.put(0, rows(0, 10))
    ends = []

    def late(memory):
        ends.append(int(memory._ints[0]))
        if len(ends) == 1:
            mine.put(RING - 10, rows(100, 40))  # round the ring, over where target 9 was
        return ends[-1]

    monkeypatch.setattr(ArmMemory, "end", property(late))
    np.testing.assert_array_equal(theirs.target(RING - 12.0), rows(9, 1)[0])
    assert len(ends) == 4


def test_before_the_first_target_is_the_first(pair):
    mine, theirs = pair
    mine.put(0, rows(7, 3))
    for index in (-0.0, -1e-3, -0.5, -1.0, -3.0, -17.3):
        np.testing.assert_array_equal(theirs.target(index), rows(7, 1)[0])


def test_targets_that_leave_a_gap_are_refused(pair):
    mine, theirs = pair
    with pytest.raises(SettingsError, match="there are no targets"):
        theirs.target(0)
    for first, count in ((1, 1), (-1, 1), (0, 0)):
        with pytest.raises(SettingsError, match="do not continue"):
            mine.put(first, np.zeros((count, 6)))
    with pytest.raises(SettingsError, match="do not fit"):
        mine.put(0, np.zeros((RING // 2 + 1, 6)))
    assert theirs.end == 0
    mine.put(0, np.zeros((RING // 2, 6)))
    assert theirs.end == RING // 2


@given(st.lists(st.floats(-3, 3), min_size=4, max_size=4), st.integers(0, 20), st.floats(0, 1))
def test_targets_are_interpolated_smoothly(cubic, number, share):
    memory = ArmMemory()
    numbers = np.arange(30.0)[:, None]
    memory.put(0, np.polyval(cubic, numbers / 30) + np.zeros(6))
    index = number + share
    # A parabola lies on it; of a cubic it keeps within what its third difference is.
    third = abs(cubic[0]) * 6 / 30**3
    inside = max(1.0, index)
    found = memory.target(inside)
    np.testing.assert_allclose(found, np.polyval(cubic, inside / 30), atol=third / 6 + 1e-12)
    # Position and speed are continuous at every target.
    step = 1e-6
    for at in (number + 1, number + 2):
        before, here, after = (memory.target(at + way) for way in (-step, 0.0, step))
        np.testing.assert_allclose(after - here, here - before, atol=1e-10)
    memory.close()


def test_targets_may_be_written_while_they_are_read(pair):
    """As the arm's process sees it: the brake is overwritten, and the end moves back and forth."""
    mine, _ = pair
    code = (
        "import sys\nimport numpy as np\nfrom dual_ur10.sim2real.runtime.arm_memory import ArmMemory\n"
        "memory = ArmMemory(sys.argv[1])\n"
        "seen, wrong = 0, 0\nprint('ready', flush=True)\n"
        "while True:\n"
        "    target = memory.target(memory.end - 40)\n"
        "    seen, wrong = seen + 1, wrong + (target != target[0]).any()\n"
        "    if memory.stop_requested:\n        break\n"
        "print(seen, wrong, flush=True)\n"
    )
    mine.put(0, np.zeros((60, 6)))
    with subprocess.Popen([sys.executable, "-c", code, mine.name], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        for first in range(20, 3020):
            mine.put(first, np.repeat(np.arange(first, first + 60.0)[:, None], 6, axis=1))
        mine.stop()
        seen, wrong = map(int, process.stdout.readline().split())
    assert seen > 0
    assert wrong == 0


# Packets and states.


def test_sent_targets_are_kept_and_read_once(pair):
    mine, theirs = pair
    sent, following = mine.sent()
    assert (len(sent.period), following) == (0, 0)
    for number in range(5):
        theirs.note_sent(2 * number, number / 4, 100.0 + number, 0.001 * number, rows(number, 1)[0])
    sent, following = mine.sent(2)
    assert following == mine.sent_count == 5
    np.testing.assert_array_equal(sent.period, [4, 6, 8])
    np.testing.assert_array_equal(sent.index, [0.5, 0.75, 1.0])
    np.testing.assert_array_equal(sent.sent_s, [102, 103, 104])
    np.testing.assert_array_equal(sent.late_s, 0.001 * np.arange(2, 5))
    np.testing.assert_array_equal(sent.target_rad, rows(2, 3))
    assert len(mine.sent(following)[0].period) == 0


def test_the_newest_packets_and_states_are_kept(pair):
    mine, theirs = pair
    count = RING + 100
    for number in range(count):
        theirs.note_sent(number, number, number, 0.0, np.zeros(6))
    sent, following = mine.sent()
    assert following == count
    np.testing.assert_array_equal(sent.period, np.arange(count - RING + 1, count))
    status = status_of()
    for number in range(count):
        theirs.note_state(status._replace(timestamp_s=float(number)) if number % 100 == 0 else status)
    states, following = mine.states()
    assert (len(states), following) == (RING - 1, count)


def test_states_arrive_as_they_are(pair):
    mine, theirs = pair
    assert mine.status is None
    told = [status_of(timestamp=float(number), actual_q=(0.1 * number,) * 6) for number in range(4)]
    for status in told:
        theirs.note_state(status)
    assert mine.status == told[-1]
    states, following = mine.states(1)
    assert following == mine.state_count == 4
    assert [type(told[0]).from_row(row) for row in states] == told[1:]


@pytest.mark.parametrize("before", [0, RING - 3])  # also where the ring is written from its start again
def test_the_effect_of_a_target_is_found_among_the_newest_states(pair, before):
    mine, theirs = pair
    assert mine.sent_s(0.0) is None
    assert mine.status_after(0.0, 1) is None
    for _ in range(before):
        theirs.note_sent(0, -1.0, 0.0, 0.0, np.zeros(6))
        theirs.note_state(status_of()._replace(arrival_s=0.0))
    for number in range(6):
        theirs.note_sent(number, number / 2, 100.0 + number, 0.0, np.zeros(6))
        theirs.note_state(status_of()._replace(arrival_s=100.5 + number))
    assert [mine.sent_s(index) for index in (0.5, 0.6, 2.5, 2.6)] == [101.0, 102.0, 105.0, None]
    found = [mine.status_after(102.0, number) for number in (1, 2, 4, 5)]
    assert [each and each.arrival_s for each in found] == [102.5, 103.5, 105.5, None]
    assert mine.status_after(200.0, 1) is None


def test_a_result_does_not_change_later(pair):
    mine, theirs = pair
    mine.put(0, rows(0, 4))
    theirs.note_sent(0, 0.0, 1.0, 0.0, rows(0, 1)[0])
    target, sent = theirs.target(0), mine.sent()[0]
    mine.put(0, rows(50, 4))
    theirs.note_sent(1, 1.0, 2.0, 0.0, rows(1, 1)[0])
    np.testing.assert_array_equal(target, rows(0, 1)[0])
    np.testing.assert_array_equal(sent.target_rad, rows(0, 1))
    target[:] = np.nan  # nor does the memory, by what was read
    assert np.isfinite(theirs.target(0)).all()


# Phases.


def test_phases_go_up_only_and_keep_their_reason(pair):
    mine, theirs = pair
    assert mine.phase == Phase.STARTING
    assert mine.text == ""
    theirs.enter(Phase.READY)
    theirs.enter(Phase.STOPPING, "left: größer als erlaubt" + "x" * 5000)
    theirs.enter(Phase.STREAMING, "and on")
    theirs.enter(Phase.STOPPING, "another reason")
    assert mine.phase == Phase.STOPPING
    assert mine.text.startswith("left: größer als erlaubt")
    assert len(mine.text) < 1024
    theirs.enter(Phase.STOPPED)  # without a word: the reason stays
    assert mine.text.startswith("left: größer als erlaubt")
    theirs.enter(Phase.FAULTED, "short")
    assert mine.text == "short"


def test_a_text_may_be_cut_anywhere():
    for length in range(1018, 1028):
        block = SharedBlock({"text": (np.uint8, (1024,))})
        block.set_text("text", "x" * length + "ü")
        assert block.text("text").startswith("x" * min(length, 1022))
        block.close()


def test_signs_of_life_and_a_stop_arrive(pair):
    mine, theirs = pair
    assert (mine.beat_s, theirs.stop_requested, mine.skipped) == (0.0, False, 0)
    theirs.beat(12.5)
    theirs.note_skipped(3)
    theirs.note_skipped(2)
    mine.stop()
    assert (mine.beat_s, theirs.stop_requested, mine.skipped) == (12.5, True, 5)


# The memory itself.


def test_memory_that_is_closed_is_gone():
    memory = ArmMemory()
    name = memory.name
    memory.put(0, np.ones((1, 6)))
    memory.close()
    memory.close()
    assert (memory.phase, memory.end, memory.status) == (Phase.STARTING, 0, None)
    with pytest.raises(FileNotFoundError):
        ArmMemory(name)


def test_foreign_memory_is_refused():
    block = SharedBlock({"ints": (np.int64, (16,))})
    with pytest.raises(SettingsError, match="is another's"):
        ArmMemory(block.name)
    block.close()


def test_arrays_do_not_overlap():
    layout = {"bytes": (np.uint8, (5,)), "ints": (np.int64, (3,)), "more": (np.float64, (2, 2))}
    block = SharedBlock(layout)
    block["bytes"][:], block["ints"][:], block["more"][:] = 255, -1, 2.5
    other = SharedBlock(layout, block.name)
    assert (other["bytes"] == 255).all()
    assert (other["ints"] == -1).all()
    assert (other["more"] == 2.5).all()
    block.close()
    assert (block["ints"] == 0).all()
    assert (other["ints"] == -1).all()  # it lives as long as anybody has it
    other.close()


def test_nothing_is_left_when_a_program_ends_without_closing():
    code = (
        "from dual_ur10.sim2real.runtime.arm_memory import ArmMemory\n"
        "memory = ArmMemory()\nprint(memory.name, flush=True)\nimport os\nos._exit(0)\n"
    )
    name = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    assert name.startswith("/proc/")
    with pytest.raises(FileNotFoundError):
        ArmMemory(name)
