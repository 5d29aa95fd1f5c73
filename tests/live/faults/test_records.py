"""Records that cannot be written: row 59 of docs/reference/faults.md."""

import resource

import pytest

from dual_ur10.sim2real.recording.reader import read_run
from tests.live.faults.lab import ARMS

pytestmark = pytest.mark.streams

WRITTEN_TICKS = 150  # until the recorder writes, and the program hears of it


def full(lab):
    """Let the disk have no room for records from now on."""
    lab.note()
    process = lab.env.unwrapped.core._hook.recorder.process
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (1000, 1000))


def test_59_a_full_disk_stops_both_on_request(lab, tmp_path):
    lab.begin(record=str(tmp_path), record_failure="stop")
    full(lab)
    error = lab.step_until_faulted()
    words = "the run is not recorded any more", "File too large"
    lab.assert_stopped(error, *words, seen_ticks=WRITTEN_TICKS, ramped=ARMS)
    folder = max(tmp_path.iterdir())
    assert not read_run(folder, allow_partial=True).complete
