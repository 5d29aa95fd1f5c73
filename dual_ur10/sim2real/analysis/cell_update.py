"""Update of a cell file with measured lookahead and latency. The former file is kept as a backup."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import tomlkit
from tomlkit.items import InlineTable

from dual_ur10.errors import CellFileError, DualUR10Error, RecordingError
from dual_ur10.files import check_target, write_text
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.sim2real.analysis.fit import ArmFit
from dual_ur10.sim2real.config.cell_file import CellFile, examine_text, load_cell_file
from dual_ur10.sim2real.config.cell_file_tables import MAX_LATENCY_S, Measured
from dual_ur10.sim2real.control.servoj import MEASURED_LOOKAHEAD_S
from dual_ur10.sim2real.recording.run import Header

_MOST_BACKUPS: Final = 1000
_MOST_SIGMA: Final = 0.1
"""Largest standard deviation of an estimate that is written, as a fraction of the servoj lookahead."""


def write_back(path: str | Path, header: Header, found: Sequence[ArmFit]) -> Path:
    """Write measured lookahead and latency of both arms into a cell file, as tables `measured`.

    Comments stay. The former file is kept as `NAME.bak`, or `NAME.bak1` and so on where there are such files.

    Args:
        path: The cell file.
        header: Header of the run that was fitted.
        found: Fit of each arm; the estimate of controller and arm together is written.

    Returns:
        Path of the backup.

    Raises:
        RecordingError: The run is of another cell, or there is no certain estimate for an arm. Nothing is written.
        CellFileError: The cell file is not legal, or would not be. Nothing is written.
        DualUR10Error: A file cannot be written. The cell file is unchanged.
    """
    target = check_target(path)
    cell = load_cell_file(target)
    _check_same_cell(cell, header)
    measured = [_measured(arm, each) for arm, each in zip(ARMS, found, strict=True)]
    text = target.read_bytes().decode("utf-8")
    left, right = (arm.replace(measured=each) for arm, each in zip(cell.arms, measured, strict=True))
    updated = _updated(text, cell.replace(left=left, right=right), measured)
    kept = _keep(target)
    write_text(target, updated)
    return kept


def _measured(arm: str, found: ArmFit) -> Measured:
    each = found.arm
    if each.reason:
        raise RecordingError(f"{arm}: there is no estimate to write: {each.reason}. Fit a run in which both arms move")
    most = _MOST_SIGMA * found.lookahead_set_s
    if not (each.lookahead_sigma_s <= most and each.latency_sigma_s <= most):  # NaN is refused
        raise RecordingError(
            f"{arm}: lookahead {1e3 * each.lookahead_s:.2f} ± {1e3 * each.lookahead_sigma_s:.2f} ms and latency "
            f"{1e3 * each.latency_s:.2f} ± {1e3 * each.latency_sigma_s:.2f} ms are too uncertain to be written: "
            f"± {1e3 * most:.2f} ms is the most. Fit a longer run, with faster motion"
        )
    # Only significant digits. A latency just below zero counts as 0.
    lookahead_s, latency_s = round(each.lookahead_s, 6), max(round(each.latency_s, 6), 0.0)
    low, high = MEASURED_LOOKAHEAD_S
    if not (low <= lookahead_s <= high and each.latency_s >= -most and latency_s <= MAX_LATENCY_S):
        raise RecordingError(
            f"{arm}: lookahead {lookahead_s:g} s and latency {each.latency_s:g} s are no figures of a controller: "
            f"{low:g} to {high:g} s and 0 to {MAX_LATENCY_S:g} s are expected. Fit another run"
        )
    return Measured(lookahead_s=lookahead_s, latency_s=latency_s)


def _check_same_cell(cell: CellFile, header: Header) -> None:
    if header.source != cell.kind:
        raise RecordingError(
            f"the run is {header.source!r}, the cell file {cell.kind!r}: only a run of this cell shows how its arms "
            "move. Name a run that was recorded with this file"
        )
    if header.family != cell.left.family:
        raise RecordingError(
            f"the run is of {header.family} controllers, the cell file of {cell.left.family}: they have to be the "
            "same. Name a run that was recorded with this file"
        )
    for arm, entry, used in zip(ARMS, cell.arms, header.servoj, strict=True):
        if not math.isclose(used["gain"], entry.servoj.gain) or not math.isclose(
            used["lookahead_s"], entry.servoj.lookahead_s
        ):
            raise RecordingError(
                f"{arm}: the run was made with servoj lookahead_s = {used['lookahead_s']:g} and gain = "
                f"{used['gain']:g}, the cell file has {entry.servoj.lookahead_s:g} and {entry.servoj.gain:g}: they "
                "have to be the same. Record a run with this file"
            )
    if header.cell_file is None:
        return
    recorded, _ = examine_text(header.cell_file, "the recording's cell file")
    if recorded is None:
        raise RecordingError("the recording's cell file is not legal: the recording is damaged. Record another run")
    for arm, entry, before in zip(ARMS, cell.arms, recorded.arms, strict=True):
        # An emulated cell has other ports at each start, and maybe another host, but the same arms.
        if cell.kind == "real" and (entry.host, entry.serial_number) != (before.host, before.serial_number):
            raise RecordingError(
                f"{arm}: the run was recorded with the controller {before.host} of robot {before.serial_number}, the "
                f"cell file names {entry.host} of robot {entry.serial_number}: they have to be the same. Name a run "
                "that was recorded with this file"
            )


def _updated(text: str, wanted: CellFile, measured: Sequence[Measured]) -> str:
    """Return the text of the file with the measured values, and all else unchanged.

    Raises:
        CellFileError: The result is not the wanted cell.
    """
    document = tomlkit.parse(text)
    for arm, each in zip(ARMS, measured, strict=True):
        entry: Any = document[arm]
        if "measured" not in entry:
            inline = isinstance(entry, InlineTable)
            entry["measured"] = tomlkit.inline_table() if inline else tomlkit.table()
        entry["measured"]["lookahead_s"], entry["measured"]["latency_s"] = each.lookahead_s, each.latency_s
    changed = document.as_string()
    found, findings = examine_text(changed)
    if found != wanted:
        reason = findings[0] if findings else "it would say something else"
        raise CellFileError(
            f"{wanted.source}: the measured values cannot be put into this file: {reason}. Nothing was changed; put "
            + "".join(f"[{arm}.measured] {each}, " for arm, each in zip(ARMS, measured, strict=True))
            + "into it by hand"
        )
    return changed


def _keep(target: Path) -> Path:
    content = target.read_bytes()
    for number in range(_MOST_BACKUPS):
        kept = target.with_name(f"{target.name}.bak{number or ''}")
        try:
            with kept.open("xb") as file:
                file.write(content)
                file.flush()
        except FileExistsError:
            continue
        except OSError as error:
            with contextlib.suppress(OSError):
                kept.unlink()
            raise DualUR10Error(f"cannot keep {target} as {kept}: {error}. Nothing was changed") from error
        return kept
    raise DualUR10Error(f"there are {_MOST_BACKUPS} backups of {target}: move some away. Nothing was changed")
