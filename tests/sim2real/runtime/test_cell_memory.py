"""Memory shared by all processes of a cell."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import astuple
from unittest import mock

import pytest

from dual_ur10.errors import LinkError, SettingsError
from dual_ur10.sim2real.control.time_scaling import TimeScaling
from dual_ur10.sim2real.runtime.arm_memory import ArmMemory
from dual_ur10.sim2real.runtime.cell_memory import CellMemory
from ur_core.kernel import Counters


@pytest.fixture
def pair():
    mine = CellMemory()
    theirs = CellMemory(mine.name)
    yield mine, theirs
    theirs.close()
    mine.close()


def test_initial_values(pair):
    for memory in pair:
        assert memory.time_scaling == TimeScaling()
        assert memory.largest_scaling == 1.0
        assert (memory.begin_s, memory.supervisor_beat_s, memory.fresh) == (0.0, 0.0, 0.0)
        assert (memory.ready, memory.ending, memory.live, memory.fault) == (False, False, False, "")
        assert memory.coupled is False


def test_coupling_begins_and_ends(pair):
    mine, theirs = pair
    mine.couple(True)
    assert theirs.coupled
    mine.couple(False)
    assert not theirs.coupled


def test_opening_memory_changes_no_scaling(pair):
    mine, _ = pair
    mine.set_time_scaling(TimeScaling(1.0, 2.0, 0.5, 0.25, 0.01))
    third = CellMemory(mine.name)
    assert mine.time_scaling == third.time_scaling == TimeScaling(1.0, 2.0, 0.5, 0.25, 0.01)
    third.close()


def test_all_processes_see_all_values(pair):
    mine, theirs = pair
    for writer, reader in (pair, pair[::-1]):
        writer.begin(12.5)
        writer.expect(40.5, live=True)
        writer.note_supervisor(13.5)
        assert (reader.begin_s, reader.fresh, reader.live, reader.supervisor_beat_s) == (12.5, 40.5, True, 13.5)
        writer.expect(0.0, live=False)
        # Who has just seen that the policy owed targets must not read another number of them.
        assert (reader.fresh, reader.live) == (40.5, False)
        writer.begin(0.0)
    assert not theirs.ready
    mine.enter_ready()
    assert theirs.ready
    assert not theirs.ending
    mine.end()
    assert theirs.ending


def test_scalings_follow_each_other(pair):
    mine, theirs = pair
    scaling = TimeScaling()
    for number in range(50):
        scaling = scaling.towards((number % 7) / 8, 100.0 * number, 0.008)
        mine.set_time_scaling(scaling)
        assert astuple(theirs.time_scaling) == astuple(scaling)


def test_a_scaling_is_written_before_it_is_the_newest(pair):
    mine, theirs = pair
    numbers, seen = mine._ints, []

    class Watched:
        """Looks, as another process may, after every write."""

        def __getitem__(self, key):
            return numbers[key]

        def __setitem__(self, key, value):
            numbers[key] = value
            seen.append(theirs.time_scaling)

    mine._ints = Watched()
    mine.set_time_scaling(TimeScaling(1.0, 2.0, 0.5, 0.25, 0.01))
    assert seen == [TimeScaling(1.0, 2.0, 0.5, 0.25, 0.01)]


def test_a_scaling_is_read_whole_while_it_is_written(pair):
    mine, _ = pair
    code = (
        "import sys\nfrom dual_ur10.sim2real.runtime.cell_memory import CellMemory\n"
        "memory = CellMemory(sys.argv[1])\n"
        "seen = set()\n"
        "for _ in range(10_000_000):\n"
        "    seen.add(memory.time_scaling)\n"
        "    if len(seen) == 1_500:\n"
        "        break\n"
        "print(len(seen), sum(scaling.index != 2 * scaling.period for scaling in seen))\n"
    )
    mine.set_time_scaling(TimeScaling(0.0, 0.0))
    with subprocess.Popen([sys.executable, "-c", code, mine.name], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for number in range(30_000_000):
            mine.set_time_scaling(TimeScaling(number, 2.0 * number))
            if number % 1000 == 0 and process.poll() is not None:
                break
        seen, wrong = map(int, process.stdout.read().split())
    assert seen > 1
    assert wrong == 0


def test_a_scaling_overwritten_during_a_read_is_read_again(pair, monkeypatch):
    mine, theirs = pair
    mine.set_time_scaling(TimeScaling(1.0, 1.0))
    scalings, sequence = theirs._scalings, theirs._ints

    class Slow:
        """The writer goes round all rows while this one is copied."""

        times = 0

        def __getitem__(self, row):
            values = scalings[row].copy()
            if Slow.times:
                Slow.times -= 1
                values[:] = -1.0  # torn
                for number in range(4):
                    mine.set_time_scaling(TimeScaling(10.0 + number, 2.0))
            return values

    monkeypatch.setattr(theirs, "_scalings", Slow())
    Slow.times = 3
    assert theirs.time_scaling == TimeScaling(13.0, 2.0)
    mine.set_time_scaling(TimeScaling(20.0, 2.0))  # a reader reads new ones only
    Slow.times = 10_000
    with pytest.raises(LinkError, match="faster than it can be read"):
        theirs.time_scaling  # noqa: B018
    assert sequence[0] > 16


def test_the_first_fault_stays(pair):
    mine, theirs = pair
    theirs.enter_fault("right: größer als erlaubt" + "x" * 5000)
    mine.enter_fault("another")
    assert mine.fault == theirs.fault
    assert mine.fault.startswith("right: größer als erlaubt")
    assert len(mine.fault) < 2048


@pytest.mark.parametrize("others", [1, 40])
def test_a_fault_stays_whole_while_others_enter_theirs(pair, monkeypatch, others):
    mine, theirs = pair
    write, seen = mine._block.set_text, []

    def interrupted(key, text):
        write(key, text[: len(text) // 2])
        for number in range(others):
            theirs.enter_fault(f"{number}: theirs")
            seen.append(theirs.fault)
        write(key, text)

    monkeypatch.setattr(mine._block, "set_text", interrupted)
    mine.enter_fault("mine, and much longer than theirs")
    assert set(seen) == {"0: theirs"}
    assert mine.fault == theirs.fault == "0: theirs"


def test_a_writer_that_dies_loses_no_fault(pair, monkeypatch):
    mine, theirs = pair
    with monkeypatch.context() as patch:
        patch.setattr(mine._block, "set_text", mock.Mock(side_effect=KeyboardInterrupt))
        for _ in range(100):
            with pytest.raises(KeyboardInterrupt):
                mine.enter_fault("never written")
    assert not theirs.fault
    theirs.enter_fault("another")
    assert mine.fault == "another"


def test_counters_are_those_of_the_kernel_in_all_shared_memory(pair):
    """Plain stores are seen in their order by x86 alone."""
    arm = ArmMemory()
    for memory in (*pair, arm):
        assert isinstance(memory._ints, Counters)
    arm.close()
    assert isinstance(arm._ints, Counters)


def test_the_begin_is_seen_with_what_was_written_before(pair):
    mine, theirs = pair
    mine._floats[2] = 12.5  # seen early, as other processors may show it
    assert theirs.begin_s == 0.0
    mine.begin(12.5)
    assert theirs.begin_s == 12.5


def test_memory_that_is_closed_is_gone():
    memory = CellMemory()
    name = memory.name
    memory.begin(3.0)
    memory.close()
    memory.close()
    assert memory.begin_s == 0.0
    with pytest.raises(FileNotFoundError):
        CellMemory(name)
    arm = ArmMemory()
    with pytest.raises(SettingsError, match="is another's"):
        CellMemory(arm.name)
    arm.close()


def test_a_reason_that_cannot_be_written_is_a_reason(pair):
    mine, theirs = pair
    mine.enter_fault("policy: cannot open weights\udc80.npz")
    assert theirs.fault == "policy: cannot open weights?.npz"
