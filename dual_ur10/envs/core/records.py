"""What records an environment's run."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dual_ur10.envs.core.options import EnvOptions
from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.config.cell import Cell, CellConfig
from dual_ur10.sim2real.recording.describe import describe
from dual_ur10.sim2real.recording.recorder import RecorderProcess
from dual_ur10.sim2real.recording.rows import RunRecorder
from dual_ur10.sim2real.recording.run import Header
from dual_ur10.sim2real.recording.simulation import SimulationRecord
from dual_ur10.sim2real.recording.writer import new_folder
from dual_ur10.sim2real.runtime.latch import state_folder
from dual_ur10.sim2real.runtime.rtde_cell import RtdeCell

_LEFT_OUT = ("cell", "confirm", "record", "record_failure", "record_about")


def recorder_of(
    task: str, keywords: Mapping[str, Any], options: EnvOptions, config: CellConfig, cell: Cell, ticks: int
) -> RunRecorder | None:
    """What records a run of this cell; None: nothing does.

    A cell of two controllers always has a black box.

    Args:
        task: Name of the task.
        keywords: Those of the environment.
        options: Likewise.
        config: Of the cell.
        cell: The cell.
        ticks: Control periods of a step.

    Raises:
        SettingsError: There are several cells.
        RecordingError: A file cannot be made.
    """
    if options.record is None and not isinstance(cell, RtdeCell):
        return None
    if cell.n > 1:
        raise SettingsError(f"{cell.n} cells are stepped together: only one alone can be recorded")
    file, about = config.file, dict(options.record_about or {})
    header = describe(
        f"DualUR10/{task}-v0",
        {
            **({"cell": keywords["cell"]} if "cell" in keywords and file is None else {}),
            **{name: value for name, value in keywords.items() if name not in _LEFT_OUT},
            "action_latency_ticks": options.latency_ticks(config),
        },
        config,
        period_ticks=ticks,
        latency_ticks=options.latency_ticks(config),
        source=config.kind,
        speed_factor=config.speed_factor,
        cell_file=None if file is None else file.text(),
        policy=about.pop("policy", ""),
        policy_sha256=about.pop("policy_sha256", None),
        extra=about,
    )
    folder = None if options.record is None else new_folder(Path(options.record), header)
    try:
        if not isinstance(cell, RtdeCell):
            return None if folder is None else SimulationRecord(folder, header)
        return _of_arms(cell, folder, header)
    except BaseException:
        if folder is not None:
            with contextlib.suppress(OSError):  # what is in it already stays
                folder.rmdir()
        raise


def _of_arms(cell: RtdeCell, folder: Path | None, header: Header) -> RecorderProcess:
    """What records two controllers."""
    boxes = state_folder() / "black_boxes" if folder is None else folder
    boxes.mkdir(mode=0o700, exist_ok=True)
    recorder = RecorderProcess(cell.memory_names, folder, header, boxes)
    recorder.wait_until_ready()
    return recorder
