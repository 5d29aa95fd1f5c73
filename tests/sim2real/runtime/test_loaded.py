"""Modules that child processes of a cell load."""

import pathlib
import sys

from ur_core.processes.child_process import Child


def modules(path: pathlib.Path) -> None:
    import dual_ur10.sim2real.recording.recorder_process
    import dual_ur10.sim2real.runtime.arm_process
    import dual_ur10.sim2real.runtime.supervisor  # noqa: F401

    path.write_text(" ".join(sys.modules))


def test_processes_of_a_cell_import_nothing_of_the_environments(tmp_path):
    """Arm processes, supervisor and recorder start with every environment on controllers, and must start fast."""
    out = tmp_path / "modules"
    assert Child(modules, out).wait(30.0)
    loaded = {each.partition(".")[0] for each in out.read_text().split()}
    assert "numpy" in loaded
    assert not loaded & {"gymnasium", "pettingzoo", "mujoco", "scipy", "pinocchio", "torch"}
