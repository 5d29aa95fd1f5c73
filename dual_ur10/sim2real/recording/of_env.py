"""Records of runs of environments and executors. The stepping core of environments loads this module by its name."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, cast

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.cell.cell import Cell, CellRequest
from dual_ur10.sim2real.recording.header import describe
from dual_ur10.sim2real.recording.hook import RecordHook
from dual_ur10.sim2real.recording.run_folder import new_folder, prepare

if TYPE_CHECKING:
    from dual_ur10.sim2real.recording.recorder import RecorderProcess
    from dual_ur10.sim2real.recording.rows import RunRecorder
    from dual_ur10.sim2real.recording.run import Header
    from dual_ur10.sim2real.runtime.rtde_cell import RtdeCell

__all__ = ["prepare", "record_env", "record_run"]

_NOT_RECORDED: Final = ("cell", "confirm", "record", "record_failure", "record_about")


def record_env(env_id: str, keywords: Mapping[str, Any], request: CellRequest, cell: Cell) -> RecordHook | None:
    """Begin the record of an environment's run; None if nothing is to be recorded.

    Args:
        env_id: Full id of the environment.
        keywords: Those of the environment; `record` and `record_about` are read here.
        request: The request for its cell.
        cell: The cell.

    Raises:
        SettingsError: There are several cells.
        RecordingError: A file cannot be made.
    """
    described = {
        **({"cell": keywords["cell"]} if "cell" in keywords and request.config.file is None else {}),
        **{name: value for name, value in keywords.items() if name not in _NOT_RECORDED},
        "action_latency_ticks": request.latency_ticks,
    }
    folder, about = keywords.get("record"), keywords.get("record_about") or {}
    recorder = record_run(env_id, described, request, cell, folder=folder, about=about)
    return None if recorder is None else RecordHook(recorder, cell)


def record_run(
    env_id: str,
    keywords: Mapping[str, Any],
    request: CellRequest,
    cell: Cell,
    *,
    folder: str | Path | None = None,
    about: Mapping[str, Any] = MappingProxyType({}),
) -> RunRecorder | None:
    """Make the recorder of a cell's run; None if nothing is to be recorded.

    A cell of two controllers always has a black box.

    Args:
        env_id: Id for the header.
        keywords: Keywords for the header.
        request: The request for the cell.
        cell: The cell.
        folder: Folder in which the run gets a folder of its own; None: black boxes only.
        about: Policy of the run, and further values for the header.

    Raises:
        SettingsError: There are several cells.
        RecordingError: A file cannot be made.
    """
    config, about = request.config, dict(about)
    if folder is None and config.file is None:
        return None
    if cell.n > 1:
        raise SettingsError(f"{cell.n} cells are stepped together: only one alone can be recorded")
    header = describe(
        env_id,
        keywords,
        config,
        period_ticks=request.ticks,
        latency_ticks=request.latency_ticks,
        source=config.kind,
        speed_factor=config.speed_factor,
        cell_file=None if config.file is None else config.file.text(),
        policy=about.pop("policy", ""),
        policy_sha256=about.pop("policy_sha256", None),
        extra=about,
        started=request.system.clock.utc(),
    )
    own = None if folder is None else new_folder(Path(folder), header)
    try:
        if config.file is not None:
            return _record_arms(cast("RtdeCell", cell), header, own)
        from dual_ur10.sim2real.recording.simulation import SimulationRecord

        return None if own is None else SimulationRecord(own, header)
    except BaseException:
        if own is not None:
            with contextlib.suppress(OSError):  # a folder that is not empty stays
                own.rmdir()
        raise


def _record_arms(cell: RtdeCell, header: Header, folder: Path | None) -> RecorderProcess:
    """Start to record the arms of two controllers, in a folder or, without one, in black boxes of their stops."""
    from dual_ur10.sim2real.recording.recorder import RecorderProcess

    boxes = cell.system.state_folder() / "black_boxes" if folder is None else folder
    boxes.mkdir(mode=0o700, exist_ok=True)
    recorder = RecorderProcess(cell.memory_names, folder, header, boxes, system=cell.system)
    recorder.wait_until_ready()
    if folder is not None:
        cell.record_cameras(folder, recorder.begin_s, recorder.event)
    return recorder
