"""Files that users name: only regular ones are read."""

import contextlib
import os
import threading
from pathlib import Path

import pytest

from dual_ur10.emulated.cell_emulator import write_cell_file
from dual_ur10.errors import DualUR10Error
from dual_ur10.policies.training.folder import _training_of
from dual_ur10.policies.training.state import load_tensors
from dual_ur10.sim2real.calibration import data_file, ur_calibration
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.trajectory.files import read_trajectory
from ur_emulator.controller.program_files import script_texts


@contextlib.contextmanager
def pipe(path: Path):
    """Make a named pipe that holds a byte, and check that nobody reads it. Whoever does, waits for ten seconds."""
    path.parent.mkdir(exist_ok=True)
    os.mkfifo(path)
    end = os.open(path, os.O_RDWR)
    os.write(end, b"#")
    timer = threading.Timer(10.0, os.close, (end,))
    timer.start()
    yield path
    timer.cancel()
    assert os.read(end, 1) == b"#"
    os.close(end)


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("kinematics.yaml", lambda path: ur_calibration.read(path, "ur10")),
        ("data.json", data_file.read),
        ("cell.toml", load_cell_file),
        ("path.csv", read_trajectory),
        ("path.json", read_trajectory),
        ("cell.toml", lambda path: write_cell_file(path, {"kind": "emulated"})),
        ("programs/wait.script", lambda path: script_texts(path.parent)),
        ("training.json", _training_of),
        ("training.safetensors", load_tensors),
    ],
)
def test_a_pipe_is_refused(tmp_path, name, read):
    with pipe(tmp_path / name) as path, pytest.raises(DualUR10Error, match="no regular file"):
        read(path)
