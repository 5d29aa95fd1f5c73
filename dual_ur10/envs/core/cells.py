"""The cell of an environment, and the recorder of its run."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.config.cell import Cell, CellRequest
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.recording.rows import RunRecorder

if TYPE_CHECKING:
    from dual_ur10.sim2real.recording.recorder import RecorderProcess
    from dual_ur10.sim2real.recording.run import Header
    from dual_ur10.sim2real.runtime.rtde_cell import RtdeCell

_NOT_RECORDED: Final = ("cell", "confirm", "record", "record_failure", "record_about")


def request_for(setup: EnvSetup, n: int, *, threads: int, clearance: Clearance) -> CellRequest:
    """Return the request for the cell of an environment.

    Args:
        setup: Of the environment.
        n: Number of cells.
        threads: Threads to simulate on.
        clearance: Measures the distances on the path to a start.
    """
    return CellRequest(
        config=setup.config,
        ticks=setup.ticks,
        limits=setup.limits,
        clearance=clearance,
        n=n,
        threads=threads,
        latency_ticks=setup.latency_ticks,
        randomized=not setup.randomization.is_none,
        varied=setup.randomization.varied,
        contacts=setup.contacts,
        couples=setup.task_type.couples,
        confirm=setup.options.confirm,
        only=setup.options.arm,
        system=setup.system,
    )


def make_recorder(setup: EnvSetup, keywords: Mapping[str, Any], cell: Cell) -> RunRecorder | None:
    """Make the recorder of a run of this cell; None if nothing is to be recorded.

    A cell of two controllers always has a black box.

    Args:
        setup: Of the environment.
        keywords: Those that it follows from.
        cell: The cell.

    Raises:
        SettingsError: There are several cells.
        RecordingError: A file cannot be made.
    """
    options, config = setup.options, setup.config
    if options.record is None and config.file is None:
        return None
    if cell.n > 1:
        raise SettingsError(f"{cell.n} cells are stepped together: only one alone can be recorded")
    from dual_ur10.sim2real.recording.header import describe
    from dual_ur10.sim2real.recording.run_folder import new_folder
    from dual_ur10.sim2real.recording.simulation import SimulationRecord
    from dual_ur10.sim2real.runtime.rtde_cell import RtdeCell

    file, about = config.file, dict(options.record_about or {})
    header = describe(
        setup.env_id,
        {
            **({"cell": keywords["cell"]} if "cell" in keywords and file is None else {}),
            **{name: value for name, value in keywords.items() if name not in _NOT_RECORDED},
            "action_latency_ticks": setup.latency_ticks,
        },
        config,
        period_ticks=setup.ticks,
        latency_ticks=setup.latency_ticks,
        source=config.kind,
        speed_factor=config.speed_factor,
        cell_file=None if file is None else file.text(),
        policy=about.pop("policy", ""),
        policy_sha256=about.pop("policy_sha256", None),
        extra=about,
        started=setup.system.clock.utc(),
    )
    folder = None if options.record is None else new_folder(Path(options.record), header)
    try:
        if not isinstance(cell, RtdeCell):
            return None if folder is None else SimulationRecord(folder, header)
        return record_arms(cell, header, folder)
    except BaseException:
        if folder is not None:
            with contextlib.suppress(OSError):  # a folder that is not empty stays
                folder.rmdir()
        raise


def record_arms(cell: RtdeCell, header: Header, folder: Path | None = None) -> RecorderProcess:
    """Start to record the arms of two controllers, in a folder or, without one, in black boxes of their stops.

    Raises:
        RecordingError: A file cannot be made.
    """
    from dual_ur10.sim2real.recording.recorder import RecorderProcess

    boxes = cell.system.state_folder() / "black_boxes" if folder is None else folder
    boxes.mkdir(mode=0o700, exist_ok=True)
    recorder = RecorderProcess(cell.memory_names, folder, header, boxes, system=cell.system)
    recorder.wait_until_ready()
    return recorder
