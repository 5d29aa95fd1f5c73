"""The command `cell calibrate`."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.options import check_extras, console
from dual_ur10.errors import CalibrationError, SettingsError, UnknownNameError
from ur_core.files import check_target
from ur_core.kinematics.ur10 import ARMS, DHParameters
from ur_core.processes.system import LOCAL

if TYPE_CHECKING:
    from dual_ur10.sim2real.calibration.estimate import BaseEstimate
    from dual_ur10.sim2real.calibration.observations import Noise, Observation
    from dual_ur10.sim2real.cell_file.cell_file import CellFile
    from dual_ur10.sim2real.cell_file.tables import ArmEntry, Calibration

_KINDS: Final = ("touch", "bar")
_PLANNED: Final = 8  # touches that a calibration begins with
_NOISY: Final = 3.0  # times the stated noise, from which something else is wrong
_SHOWN_ROWS: Final = 60


_Kinematics = Annotated[
    list[str] | None,
    typer.Option(
        "--kinematics",
        metavar="ARM=SOURCE",
        help="Kinematics of an arm: left=controller, or left=FILE for a YAML of ur_calibration. May be repeated.",
    ),
]
_Record = Annotated[
    str | None, typer.Option("--record", metavar="KIND", help="Record a touch or bar pose at each Enter. Read-only.")
]
_Grasp = Annotated[
    str, typer.Option("--grasp", help="Name of the grasp of recorded bar poses; another one after letting go.")
]
_Touch = Annotated[
    int | None,
    typer.Option("--touch", metavar="N", min=1, max=100, help="Simulate N touches of a running emulated cell."),
]
_AcceptM = Annotated[
    float, typer.Option("--accept-m", min=0.0, max=0.1, help="Largest uncertainty 1 m from the base that is written.")
]
_Moved = Annotated[
    bool, typer.Option("--moved", help="A base was moved: write it although it is over 0.3 m or 20° from that in FILE.")
]


def calibrate(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A cell file, such as lab.toml.")],
    data: Annotated[
        Path, typer.Option("--data", metavar="FILE", help="Observations, in JSON. Recorded ones are appended.")
    ],
    record: _Record = None,
    grasp: _Grasp = "1",
    touch: _Touch = None,
    kinematics: _Kinematics = None,
    suggest: Annotated[
        bool, typer.Option("--suggest", help="Name the observation that would improve the estimate most.")
    ] = False,
    write: Annotated[bool, typer.Option("--write", help="Write the result into FILE, and keep FILE.bak.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write the result into this new cell file instead.")
    ] = None,
    accept_m: _AcceptM = 0.001,
    moved: _Moved = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of simulated touches.")] = 0,
    camera: Annotated[
        str | None,
        typer.Option("--camera", metavar="NAME", help="Calibrate this camera of FILE from images of a board instead."),
    ] = None,
) -> None:
    """Estimate where the right base stands in the left one's frame, with its uncertainty. Moves nothing."""
    check_extras(("calibration", "an estimate of the bases"))
    from dual_ur10.sim2real.analysis.cell_update import ACCEPTED_M, doubt_about, write_bases
    from dual_ur10.sim2real.calibration import data_file
    from dual_ur10.sim2real.calibration.estimate import estimate
    from dual_ur10.sim2real.calibration.transforms import right_in_left
    from dual_ur10.sim2real.cell_file.cell_file import load_cell_file

    if record is not None and record not in _KINDS:
        raise UnknownNameError("kind of observation", record, _KINDS)
    if write and out is not None:
        raise SettingsError("--write changes the cell file, --out writes another one: leave one of them out")
    check_target(data)
    cell = load_cell_file(file)
    near = right_in_left(cell.left.mount, cell.right.mount)
    tables = _kinematics(cell, kinematics or ())
    dh = (_dh(cell, tables, ARMS[0]), _dh(cell, tables, ARMS[1]))
    if camera is not None:
        others = record, touch, suggest, out, moved, grasp, accept_m, seed
        if others != (None, None, False, None, False, "1", ACCEPTED_M, 0):
            raise SettingsError("--camera takes --data, --kinematics and --write alone: leave the others out")
        _calibrate_camera(file, data, camera, cell, dh, write=write)
        return
    if touch is not None:
        _simulate(cell, data, touch, dh, near, seed)
    if record is not None:
        _record(cell, data, record, grasp, dh, near)
    if not data.exists() and suggest:
        _print_plan(cell, dh, near)
        return
    content = data_file.read(data)
    noise, observations = content.standard_deviations(), content.measured(data.parent)
    try:
        found = estimate(observations, dh, near, noise)
    except CalibrationError as error:
        if suggest and observations:
            _print_next(cell, dh, near, noise, observations, None)
        raise error
    writes = write or out is not None
    _print_estimate(found, None if writes and not moved else doubt_about(found, cell))  # a refusal tells it anyway
    _print_residuals(found, observations)
    if suggest:
        _print_next(cell, dh, near, noise, observations, found)
    if writes:
        day = LOCAL.clock.utc().date()
        kept = write_bases(file, found, data, day=day, kinematics=tables, accept_m=accept_m, out=out, moved=moved)
        where = f"wrote {out}" if kept is None else f"wrote {file}; as it was: {kept}"
        console.print(where, soft_wrap=True, highlight=False, markup=False)


def _calibrate_camera(
    file: Path, data: Path, name: str, cell: CellFile, dh: tuple[DHParameters, DHParameters], *, write: bool
) -> None:
    """Estimate intrinsics and pose of a camera from images of a board."""
    import numpy as np

    from dual_ur10.sim2real.analysis.cell_update import write_camera
    from dual_ur10.sim2real.calibration import data_file
    from dual_ur10.sim2real.calibration.camera_pose import BODY, body_in_cell, estimate_camera

    def frame(carrier: str, joints: tuple[Any, Any]) -> Any:
        if carrier not in ARMS:
            return np.eye(4)
        arm = ARMS.index(carrier)
        return body_in_cell(cell.arms[arm].mount, joints[arm], dh[arm])

    views, size, carrier = data_file.read(data).corner_views(data.parent, frame)
    found = estimate_camera(views, size)
    body = f"{carrier}/{BODY}" if carrier in ARMS else ""
    table = Table(header_style="bold", title=f"camera {name} in the frame of {body or 'the cell'}")
    for header in ("", "estimate", "95 % interval"):
        table.add_column(header, justify="left" if not header else "right")
    widths = found.half_widths
    for k, axis in enumerate("xyz"):
        table.add_row(f"{axis}, mm", f"{1e3 * found.pose[k, 3]:.2f}", f"± {1e3 * widths[k]:.2f}")
    for k, axis in enumerate("xyz"):
        table.add_row(f"rotation about {axis}, °", "", f"± {math.degrees(widths[3 + k]):.3f}")
    fx, fy, cx, cy = found.intrinsics.matrix_px
    table.add_row("fx, fy, px", f"{fx:.1f}, {fy:.1f}", "")
    table.add_row("cx, cy, px", f"{cx:.1f}, {cy:.1f}", "")
    table.add_row("field of view, °", f"{math.degrees(found.fovy_rad):.2f}", "")
    console.print(table)
    console.print(f"{len(views)} images, {found.rms_px:.2f} px RMS", highlight=False)
    if write:
        kept = write_camera(file, name, found.camera(name.rpartition("/")[2], body))
        console.print(f"wrote {file}; as it was: {kept}", soft_wrap=True, highlight=False, markup=False)


def _dh(cell: CellFile, tables: dict[str, Calibration], arm: str) -> DHParameters:
    entry: ArmEntry = getattr(cell, arm)
    return entry.kinematics_of(tables.get(arm, entry.calibration))


def _kinematics(cell: CellFile, given: Sequence[str]) -> dict[str, Calibration]:
    """Return the tables `calibration` of the arms whose kinematics are given.

    Raises:
        SettingsError: A text is not ARM=SOURCE, or its kinematics are those of another model.
        DualUR10Error: A source cannot be read.
    """
    from dual_ur10.sim2real.analysis.cell_update import calibration_of
    from dual_ur10.sim2real.calibration import ur_calibration
    from ur_core.links.primary_link import read_primary

    tables: dict[str, Calibration] = {}
    for text in given:
        arm, sign, source = text.partition("=")
        if arm not in ARMS or not sign or not source or arm in tables:
            raise SettingsError(f"--kinematics {text!r}: write each arm once, as left=controller or right=FILE")
        if source == "controller":
            facts = read_primary(getattr(cell, arm).host, name=arm)
            tables[arm] = calibration_of(facts.dh(getattr(cell, arm).robot), facts.checksums)
        else:
            tables[arm] = calibration_of(ur_calibration.read(source, getattr(cell, arm).robot))
    return tables


def _tips(cell: CellFile) -> Any:
    return tuple(each.tcp_position_m or (0.0, 0.0, 0.0) for each in cell.arms)


def _simulate(cell: CellFile, data: Path, count: int, dh: Any, near: Any, seed: int) -> None:
    """Append touches of an emulated cell's arms, where both tips meet up to the noise. The arms do not move."""
    import numpy as np

    from dual_ur10.sim2real.calibration import data_file
    from dual_ur10.sim2real.calibration.observations import Noise
    from dual_ur10.sim2real.calibration.recording import emulated_base, touched
    from dual_ur10.sim2real.calibration.suggestions import plan, touch_candidates

    true, rng = emulated_base(cell), np.random.default_rng(seed)
    for each in plan(count, touch_candidates(dh, near, _tips(cell)), dh, near):
        found = touched(each.observation, dh, true, Noise(), rng)  # type: ignore[arg-type]  # a touch
        entry = data_file.TouchEntry(
            left_q_rad=found.left_q_rad,
            right_q_rad=found.right_q_rad,
            left_tcp_m=found.left_tcp_m,
            right_tcp_m=found.right_tcp_m,
        )
        data_file.append(data, entry, LOCAL.clock.utc())
    console.print(f"simulated {count} touches of the emulated cell", highlight=False)


def _record(cell: CellFile, data: Path, kind: str, grasp: str, dh: Any, near: Any) -> None:
    """Record an observation at each Enter, until q or Ctrl-C. Each is in the file at once."""
    from dual_ur10.sim2real.calibration import data_file
    from dual_ur10.sim2real.calibration.recording import read_joints

    if not sys.stdin.isatty():
        raise SettingsError("--record needs a terminal: somebody brings the arms to each pose and presses Enter")
    tips = _tips(cell)
    what = "bring both tips to one point" if kind == "touch" else "bring the bar to another pose"
    while True:
        if kind == "touch":
            observed = data_file.read(data).measured(data.parent) if data.exists() else []
            _print_next(cell, dh, near, None, observed, None)
        try:
            answer = input(f"In freedrive, {what} and hold still. Enter records, q ends: ")
        except (EOFError, KeyboardInterrupt):
            answer = "q"
        if answer.strip().lower() == "q":
            break
        try:
            left, right = read_joints(cell)
        except CalibrationError as error:
            console.print(f"[yellow]note:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
            continue
        entry = (
            data_file.TouchEntry(left_q_rad=left, right_q_rad=right, left_tcp_m=tips[0], right_tcp_m=tips[1])
            if kind == "touch"
            else data_file.BarEntry(left_q_rad=left, right_q_rad=right, grasp=grasp)
        )
        number = data_file.append(data, entry, LOCAL.clock.utc())
        console.print(f"observation {number} is in {escape(str(data))}", highlight=False, soft_wrap=True)


def _print_plan(cell: CellFile, dh: Any, near: Any) -> None:
    from dual_ur10.sim2real.calibration.suggestions import plan, touch_candidates

    series = plan(_PLANNED, touch_candidates(dh, near, _tips(cell)), dh, near)
    for number, each in enumerate(series, start=1):
        console.print(f"{number}. {each.text}", highlight=False, soft_wrap=True)
    console.print(
        f"after these {_PLANNED}, the base is expected within ± {2e3 * series[-1].expected_m:.2g} mm 1 m away",
        highlight=False,
        soft_wrap=True,
    )


def _print_next(
    cell: CellFile,
    dh: Any,
    near: Any,
    noise: Noise | None,
    observed: Sequence[Observation],
    found: BaseEstimate | None,
) -> None:
    """Print the next observation: a pose of the bar if the last one was, otherwise a touch."""
    from dual_ur10.sim2real.calibration.observations import BarPose
    from dual_ur10.sim2real.calibration.suggestions import bar_candidates, best, touch_candidates

    candidates: Sequence[Observation]
    if found is not None and isinstance(observed[-1], BarPose):
        candidates = bar_candidates(dh, found, [each for each in observed if isinstance(each, BarPose)])
    else:
        candidates = touch_candidates(dh, near if found is None else found.pose, _tips(cell))
    each = best(candidates, dh, near, noise, estimate=found, observed=observed)
    console.print(f"next: {each.text}", highlight=False, soft_wrap=True)


def _print_estimate(found: BaseEstimate, doubt: str | None) -> None:
    table = Table(header_style="bold", title="right base in the left base's frame, as the pendants show it")
    for name in ("", "estimate", "95 % interval"):
        table.add_column(name, justify="left" if not name else "right")
    rotation = (*found.tilt_rad, found.yaw_rad)
    widths = found.half_widths
    for k, name in enumerate(("x", "y", "z")):
        table.add_row(f"{name}, mm", f"{1e3 * found.position_m[k]:.3f}", f"± {1e3 * widths[k]:.3f}")
    for k, name in enumerate(("tilt about x", "tilt about y", "yaw")):
        table.add_row(f"{name}, °", f"{math.degrees(rotation[k]):.4f}", f"± {math.degrees(widths[3 + k]):.4f}")
    console.print(table)
    position_m, rotation_rad = found.mount_uncertainty
    console.print(
        f"uncertainty {1e3 * position_m:.3f} mm and {math.degrees(rotation_rad):.4f}°, together "
        f"{1e3 * found.uncertainty_at_lever_m:.3f} mm at 1 m; noise {found.noise_scale:.2f} times the stated one",
        highlight=False,
        soft_wrap=True,
    )
    console.print(f"least known: {found.weakest.text}", highlight=False, soft_wrap=True)
    notes = [] if doubt is None else [escape(doubt)]
    if found.noise_scale > _NOISY:
        notes.append(
            f"the residuals are {found.noise_scale:.1f} times the stated noise: a tool offset or the kinematics of an "
            "arm is probably wrong, see --kinematics"
        )
    for note in notes:
        console.print(f"[yellow]note:[/] {note}", highlight=False, soft_wrap=True)


def _print_residuals(found: BaseEstimate, observations: Sequence[Observation]) -> None:
    names = {"Touch": "touch", "BarPose": "bar", "BoardView": "board"}
    table = Table(header_style="bold")
    for name in ("observation", "mm", "°", "probability", ""):
        table.add_column(name, justify="right" if name not in ("observation", "") else "left")
    rows = list(zip(found.residuals, observations, strict=True))
    for number, (each, observation) in enumerate(rows, start=1):
        if number > _SHOWN_ROWS and not each.rejected:
            continue
        kind = names[type(observation).__name__]
        angle = "" if kind == "touch" else f"{math.degrees(each.angle_rad):.4f}"
        verdict = "[red]rejected: the others contradict it[/]" if each.rejected else ""
        row = (f"{number} {kind}", f"{1e3 * each.distance_m:.3f}", angle, f"{each.probability:.2g}", verdict)
        table.add_row(*row)
    console.print(table)
