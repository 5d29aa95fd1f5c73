"""Updates of a cell file with measured values: lookahead and latency, or the bases. The former file is kept."""

from __future__ import annotations

import contextlib
import datetime
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from dual_ur10.errors import CalibrationError, CellFileError, DualUR10Error, MissingExtraError, RecordingError
from dual_ur10.ids import received
from dual_ur10.sim2real.analysis.fit import ArmFit
from dual_ur10.sim2real.calibration.directions import LEVER_M
from dual_ur10.sim2real.calibration.estimate import EXCHANGED, FAR_M, FAR_RAD, BaseEstimate
from dual_ur10.sim2real.calibration.transforms import right_in_left
from dual_ur10.sim2real.cell_file.cell_file import CellFile, examine_text, load_cell_file
from dual_ur10.sim2real.cell_file.reference import write_new
from dual_ur10.sim2real.cell_file.tables import MAX_LATENCY_S, ZERO, BaseToBase, Calibration, Measured
from dual_ur10.sim2real.recording.run import Header
from ur_core.files import check_target, write_text
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import ARMS, DHParameters
from ur_core.mjcf.camera import Camera
from ur_core.servoj import MEASURED_LOOKAHEAD_S

try:
    import tomlkit
    from tomlkit.items import InlineTable
except ImportError:
    raise MissingExtraError("tomlkit", "records", "changing a cell file") from None

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
    for_hand = "".join(f"[{arm}.measured] {each}, " for arm, each in zip(ARMS, measured, strict=True))

    def put(document: Any) -> None:
        for arm, each in zip(ARMS, measured, strict=True):
            _table(document[arm], "measured").update({"lookahead_s": each.lookahead_s, "latency_s": each.latency_s})

    updated = _updated(text, cell.replace(left=left, right=right), put, for_hand)
    kept = _keep(target)
    write_text(target, updated)
    return kept


def write_camera(path: str | Path, camera: str, found: Camera) -> Path:
    """Write the pose and field of view of a camera into its table of a cell file. The former file is kept.

    Args:
        path: The cell file.
        camera: Name of the camera.
        found: The camera as a scene has it.

    Returns:
        Path of the backup.

    Raises:
        CellFileError: The file has no such camera, is not legal, or would not be. Nothing is written.
        DualUR10Error: A file cannot be written. The cell file is unchanged.
    """
    target = check_target(path)
    cell = load_cell_file(target)
    places = [number for number, each in enumerate(cell.camera) if each.name == camera]
    if not places:
        raise CellFileError(
            f"{path} has no camera {camera!r}: add a table [[camera]] with that name and its kind. Nothing was written"
        )
    values = {
        "position_m": found.position_m,
        "target_m": found.target_m,
        "up": found.up,
        "fovy_rad": round(math.radians(found.fovy_deg), _DIGITS),
        "body": found.body,
    }
    entries = list(cell.camera)
    entries[places[0]] = entries[places[0]].replace(**values)

    def put(document: Any) -> None:
        document["camera"][places[0]].update(_plain(values))

    text = target.read_bytes().decode("utf-8")
    updated = _updated(text, cell.replace(camera=tuple(entries)), put, str(_plain(values)))
    kept = _keep(target)
    write_text(target, updated)
    return kept


ACCEPTED_M: Final = 0.001
"""Default of the largest error at `LEVER_M` with which bases are written: half of what a carry allows."""

_DIGITS: Final = 7  # of metres and radians


def write_bases(
    path: str | Path,
    found: BaseEstimate,
    data: str | Path,
    *,
    day: datetime.date,
    kinematics: Mapping[str, Calibration] | None = None,
    accept_m: float = ACCEPTED_M,
    out: str | Path | None = None,
    moved: bool = False,
) -> Path | None:
    """Write the estimated pose of the right base into a cell file, and beside it day, data and uncertainty.

    The left base stays. The right one's uncertainty in the cell is that of the left one plus that of the estimate;
    what the estimate itself leaves is in the table `base_to_base`. Comments stay. The former file is kept as
    `NAME.bak`, or `NAME.bak1` and so on.

    Args:
        path: The cell file.
        found: The estimate.
        data: Its data file.
        day: Day of the calibration.
        kinematics: Calibration of arms, by name, that the estimate was made with and the file lacks.
        accept_m: Largest legal `uncertainty_at_lever_m`.
        out: New file for the result; None: change the cell file.
        moved: True if a base was moved, so that the estimate may be far from the base in the file.

    Returns:
        Path of the backup; None if the result is a new file.

    Raises:
        CalibrationError: The estimate is too uncertain, or far from the base in the file. Nothing is written.
        CellFileError: The cell file is not legal, would not be, or `out` exists. Nothing is written.
        DualUR10Error: A file cannot be written. The cell file is unchanged.
    """
    target = check_target(path)
    cell = load_cell_file(target)
    if not moved and (doubt := doubt_about(found, cell)):
        raise CalibrationError(f"{doubt}. Nothing was written")
    check_accepted(found, accept_m)
    text = target.read_bytes().decode("utf-8")
    left, right = cell.arms
    mount = found.mount(left.mount, right.mount.dh)
    left_at = left.base_position_m or ZERO
    position_m, rotation_rad = found.mount_uncertainty
    relative = found.mount(ArmMount(ZERO), right.mount.dh)
    base_to_base = BaseToBase(
        position_m=_rounded(relative.position_m),  # type: ignore[arg-type]  # three
        yaw_rad=round(relative.yaw_rad, _DIGITS),
        tilt_rad=_rounded(relative.tilt_rad),  # type: ignore[arg-type]  # two
        uncertainty_m=_rounded_up(position_m),
        uncertainty_rad=_rounded_up(rotation_rad),
        date=day.isoformat(),
        data=str(data),
    )
    apart_m = math.dist(left_at, mount.position_m)
    values = {
        "base_position_m": _rounded(mount.position_m),
        "base_yaw_rad": round(mount.yaw_rad, _DIGITS),
        "base_tilt_rad": _rounded(mount.tilt_rad),
        "base_uncertainty_m": _rounded_up(left.base_uncertainty_m + left.base_uncertainty_rad * apart_m + position_m),
        "base_uncertainty_rad": _rounded_up(left.base_uncertainty_rad + rotation_rad),
    }
    arms = dict(zip(ARMS, (left, right.replace(**values)), strict=True))
    for arm, each in (kinematics or {}).items():
        arms[arm] = arms[arm].replace(calibration=each)

    def put(document: Any) -> None:
        document[ARMS[1]].update({name: list(v) if isinstance(v, tuple) else v for name, v in values.items()})
        for arm, each in (kinematics or {}).items():
            _table(document[arm], "calibration").update(_plain(each.mapping()))
        _table(document, "base_to_base").update(_plain(base_to_base.mapping()))

    updated = _updated(text, cell.replace(**arms, base_to_base=base_to_base), put, f"[right] {values}, ")
    if out is not None:
        write_new(out, updated)
        return None
    kept = _keep(target)
    write_text(target, updated)
    return kept


def doubt_about(found: BaseEstimate, cell: CellFile) -> str | None:
    """Return why an estimate is not believed: it is far from the base in the cell file. None: it is near."""
    pose = right_in_left(cell.left.mount, cell.right.mount)
    if not found.is_far_from(pose):
        return None
    distance_m, angle_rad = found.distance_from(pose)
    remedy = (
        EXCHANGED
        if found.exchanged
        else "Check which arm is left in data and cell file, the tips and the kinematics. If a base was moved, or the "
        "file never had its pose, give --moved"
    )
    return (
        f"the right base is {distance_m:.3g} m and {math.degrees(angle_rad):.3g}° from where {cell.source} has it, "
        f"relative to the left one: allowed are {FAR_M:g} m and {math.degrees(FAR_RAD):g}°. {remedy}"
    )


def check_accepted(found: BaseEstimate, accept_m: float) -> None:
    """Refuse an estimate that is too uncertain.

    Raises:
        CalibrationError: It is.
    """
    if found.uncertainty_at_lever_m <= accept_m:
        return
    position_m, rotation_rad = found.mount_uncertainty
    remedy = (
        f"{found.weakest.text} of the right base is known least: add observations (`--suggest` names one), or "
        "accept more with --accept-m"
    )
    raise CalibrationError(
        f"the right base is uncertain by {1e3 * position_m:.3g} mm and {math.degrees(rotation_rad):.3g}°, together "
        f"{1e3 * found.uncertainty_at_lever_m:.3g} mm at {LEVER_M:g} m, accepted are {1e3 * accept_m:g} mm: {remedy}. "
        "Nothing was written"
    )


def calibration_of(dh: DHParameters, checksum: Sequence[int] | None = None) -> Calibration:
    """Return the table `calibration` of an arm's kinematics."""
    return Calibration(
        a_m=dh.a_m,  # type: ignore[arg-type]  # six of them, as of the others
        d_m=dh.d_m,  # type: ignore[arg-type]
        alpha_rad=dh.alpha_rad,  # type: ignore[arg-type]
        theta_rad=dh.theta_rad,  # type: ignore[arg-type]
        checksum=None if checksum is None else tuple(checksum),  # type: ignore[arg-type]
    )


def _rounded(values: Sequence[float]) -> tuple[float, ...]:
    return tuple(round(each, _DIGITS) for each in values)


def _rounded_up(value: float) -> float:
    return math.ceil(value * 1e6) / 1e6


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def _table(parent: Any, name: str) -> Any:
    """Return a table inside another one, made in its style if there is none."""
    if name not in parent:
        parent[name] = tomlkit.inline_table() if isinstance(parent, InlineTable) else tomlkit.table()
    return parent[name]


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
    with received("the recording's cell file"):
        recorded, _ = examine_text(header.cell_file)
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


def _updated(text: str, wanted: CellFile, put: Callable[[Any], None], for_hand: str) -> str:
    """Return the text of the file with measured values, and all else unchanged.

    Args:
        text: Text of the file.
        wanted: Cell that the result must describe.
        put: Puts the values into the document.
        for_hand: The values in words, for the message.

    Raises:
        CellFileError: The result is not the wanted cell.
    """
    document = tomlkit.parse(text)
    put(document)
    changed = document.as_string()
    found, findings = examine_text(changed)
    if found != wanted:
        reason = findings[0] if findings else "it would say something else"
        raise CellFileError(
            f"{wanted.source}: the measured values cannot be put into this file: {reason}. Nothing was changed; put "
            f"{for_hand}into it by hand"
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
