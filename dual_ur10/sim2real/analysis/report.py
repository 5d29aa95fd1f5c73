"""The comparison of two runs as one self-contained HTML file."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from dual_ur10.errors import MissingExtraError
from dual_ur10.ids import __version__
from dual_ur10.sim2real.analysis.compare import ArmComparison, Comparison, Differences
from dual_ur10.sim2real.analysis.page import Column, Item, PageTable, number, render
from dual_ur10.sim2real.analysis.parity import Parity
from dual_ur10.sim2real.analysis.series import NO_MAGNITUDES, Magnitudes
from dual_ur10.sim2real.analysis.timing import LATE_S, MOVING_M_S, RIPPLE_WINDOW_S, ArmTiming, TimingReport
from dual_ur10.sim2real.recording.run import Header
from ur_core.files import write_text
from ur_core.kinematics.ur10 import ARMS, JOINTS

_SOURCES: Final = {
    "mujoco": "simulated in MuJoCo",
    "echo": "a dry run: its states are commanded, not measured",
    "emulated": "emulated controllers, no arms",
    "real": "real arms",
}


def write_report(path: str | Path, found: Comparison, names: tuple[str, str] = ("run A", "run B")) -> None:
    """Write the report.

    Args:
        path: The file.
        found: The comparison.
        names: Names of the recordings.

    Raises:
        DualUR10Error: The file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    write_text(path, report(found, names))


def check_extra() -> None:
    """Make sure that plots can be drawn: before, not after, runs are read.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise MissingExtraError("matplotlib", "plot", "the report of a comparison")


def report(found: Comparison, names: tuple[str, str] = ("run A", "run B")) -> str:
    """Return the report as HTML; see `write_report`."""
    check_extra()
    from dual_ur10.sim2real.analysis import plots

    drawings = (plots.paths, plots.flange_error, plots.flange_vector, plots.joint_errors, plots.skew)
    return render(
        "comparison.html",
        found=found,
        names=names,
        version=__version__,
        real=any(each.source == "real" for each in found.headers),
        plots={draw.__name__: draw(found) for draw in drawings},
        tiles=_tiles(found),
        runs=_runs(found, names),
        flanges=_flanges(found),
        lag_reasons=[f"{name}: {arm.lag.reason}" for name, arm in _arms(found) if arm.lag.reason],
        joints=_joints(found),
        skews=[f"run {run}: {_skew(each)}" for run, each in zip("AB", found.timing, strict=True)],
        timing=PageTable.of("timing", _TIMING_COLUMNS, [(title, "", each) for title, each in _timings(found)]),
        timing_reasons=_timing_reasons(found),
        ripple_window_s=RIPPLE_WINDOW_S,
        moving_m_s=MOVING_M_S,
        sent=PageTable.of("sent", _SENT_COLUMNS, [(name, "", arm.sent) for name, arm in _arms(found)]),
        differences=_sent_differences(found),
    )


def _arms(found: Comparison) -> list[tuple[str, ArmComparison]]:
    return list(zip(ARMS, found.arms, strict=True))


def _tiles(found: Comparison) -> list[tuple[str, str, str]]:
    lags = [each.lag.value for each in found.arms if not each.lag.reason]
    free = [each.free.flange_m.rms for each in found.arms if each.free is not None]
    equal, compared = (sum(getattr(each.sent, name) for each in found.arms) for name in ("equal", "compared"))
    return [
        (f"{number(1e3 * max(free, default=math.nan))} mm", "flange A to B, RMS, lag taken off", "main"),
        (f"{number(1e3 * max(each.found.flange_m.rms for each in found.arms))} mm", "the same with the lag", ""),
        (f"{number(1e3 * max(lags, key=abs, default=math.nan))} ms", "B behind A, the arm with the larger lag", ""),
        (f"{equal} of {compared}", "targets equal in every bit, both arms", "main" if equal == compared else ""),
    ]


def _runs(found: Comparison, names: tuple[str, str]) -> PageTable:
    a, b = found.headers
    rows: list[tuple[str, tuple[object, object]]] = [
        ("recording", names),
        ("arms", (_SOURCES.get(a.source, a.source), _SOURCES.get(b.source, b.source))),
        ("started", (a.started_utc, b.started_utc)),
        ("policy", (a.policy or "—", b.policy or "—")),
        ("its sha256", (_short(a.policy_sha256), _short(b.policy_sha256))),
        ("replays", (_replays(a), _replays(b))),
        ("controllers", (_rate(a), _rate(b))),
        ("servoj", (_profile(a), _profile(b))),
        ("speed factor", (f"{a.speed_factor:g}", f"{b.speed_factor:g}")),
        ("action latency in ticks", (a.latency_ticks, b.latency_ticks)),
        ("seed", ("—" if a.seed is None else a.seed, "—" if b.seed is None else b.seed)),
        ("version", (a.versions.get("dual_ur10", "—"), b.versions.get("dual_ur10", "—"))),
        ("recorded to the end", ("yes" if found.complete[0] else "no", "yes" if found.complete[1] else "no")),
    ]
    columns: list[Column[tuple[object, object]]] = [
        Column("run A", "", lambda pair: str(pair[0])),
        Column("run B", "", lambda pair: str(pair[1])),
    ]
    return PageTable.of("runs", columns, [(title, "", pair) for title, pair in rows])


def _short(sha256: object) -> str:
    return f"{sha256[:16]}…" if isinstance(sha256, str) and sha256 else "—"


def _replays(header: Header) -> str:
    source = header.extra.get("replays")
    if not isinstance(source, dict):
        return "—"
    return f"episode {source.get('episode')} of {source.get('run')}, {_short(source.get('sha256'))}"


def _rate(header: Header) -> str:
    return f"{header.family}, {1 / header.tick_s:g} Hz, an action every {header.period_ticks} ticks"


def _profile(header: Header) -> str:
    each = header.servoj[0]
    return f"lookahead {each['lookahead_s']:g} s, gain {each['gain']:g}"


def _size(title: str, unit: str, spread_of: Callable[[Item], Magnitudes]) -> list[Column[Item]]:
    """Return the columns of a spread in thousandths of its unit."""
    names = (("RMS", "rms"), ("p99", "p99"), ("max", "most"))
    return [Column(f"{title} {name}".strip(), unit, _thousandths(spread_of, field)) for name, field in names]


def _thousandths(spread_of: Callable[[Item], Magnitudes], field: str) -> Callable[[Item], float]:
    return lambda item: 1e3 * float(getattr(spread_of(item), field))


def _axis_rms(k: int) -> Column[Differences]:
    return Column(f"{'xyz'[k]} RMS", "mm", lambda each: 1e3 * each.flange_axes_m[k].rms)


def _axis_mean(k: int) -> Column[Differences]:
    return Column(f"{'xyz'[k]} mean", "mm", lambda each: 1e3 * float(each.flange_mean_m[k]))


_FLANGE_COLUMNS: Final[list[Column[Differences]]] = [
    *_size("", "mm", lambda each: each.flange_m),
    *map(_axis_rms, range(3)),
    *map(_axis_mean, range(3)),
    Column("angle max", "°", lambda each: math.degrees(each.angle_rad.most)),
]


def _flanges(found: Comparison) -> PageTable:
    rows = []
    for name, arm in _arms(found):
        rows.append((f"{name}, as it is", "", arm.found))
        if arm.free is not None:
            rows.append((f"{name}, {number(1e3 * arm.lag.value)} ms lag off", "ours", arm.free))
    rows.append(("left − right, as it is", "", _vector(found.vector_m)))
    rows.append(("left − right, lags off", "ours", _vector(found.vector_free_m)))
    return PageTable.of("flanges", _FLANGE_COLUMNS, rows)


def _vector(size: Magnitudes) -> Differences:
    """Return differences of which only the distance is known."""
    return Differences((NO_MAGNITUDES,) * 6, size, (NO_MAGNITUDES,) * 3, np.full(3, math.nan), NO_MAGNITUDES)


_Joint = tuple[Magnitudes, ...]

_JOINT_COLUMNS: Final[list[Column[_Joint]]] = [
    *_size(ARMS[0], "mrad", lambda sizes: sizes[0]),
    *_size(ARMS[1], "mrad", lambda sizes: sizes[1]),
]


def _joints(found: Comparison) -> PageTable:
    rows = []
    for joint, name in enumerate(JOINTS):
        title = name.removesuffix("_joint").replace("_", " ")
        free = (NO_MAGNITUDES if arm.free is None else arm.free.joints_rad[joint] for arm in found.arms)
        rows.append((f"{title}, as it is", "", tuple(arm.found.joints_rad[joint] for arm in found.arms)))
        rows.append((f"{title}, lag taken off", "ours", tuple(free)))
    return PageTable.of("joints", _JOINT_COLUMNS, rows)


def _later(k: int) -> Column[ArmTiming]:
    return Column(f"later than {1e3 * LATE_S[k]:g} ms", "%", lambda arm: 100 * arm.late.ratios[k])


_TIMING_COLUMNS: Final[list[Column[ArmTiming]]] = [
    Column("behind targets", "ms", lambda arm: 1e3 * arm.behind.value),
    Column("targets", "", lambda arm: arm.late.targets),
    *map(_later, range(len(LATE_S))),
    Column("latest", "ms", lambda arm: 1e3 * arm.late.most_s),
    Column("missed", "periods", lambda arm: arm.late.missed),
    *_size("ripple", "mm/s", lambda arm: arm.ripple.size_m_s),
    Column("start pose max", "mm", lambda arm: 1e3 * arm.repeatability.most_m),
    Column("start pose ISO", "mm", lambda arm: 1e3 * arm.repeatability.iso_m),
]


def _timings(found: Comparison) -> list[tuple[str, ArmTiming]]:
    runs = zip("AB", found.timing, strict=True)
    return [(f"run {run}, {name}", arm) for run, each in runs for name, arm in zip(ARMS, each.arms, strict=True)]


def _timing_reasons(found: Comparison) -> list[str]:
    reasons = (
        f"{title}, no {what}: {reason}"
        for title, arm in _timings(found)
        for what, reason in (
            ("lag behind its targets", arm.behind.reason),
            ("ripple", arm.ripple.reason),
            ("repeatability", arm.repeatability.reason),
        )
        if reason
    )
    return list(dict.fromkeys(reasons))


def _skew(timing: TimingReport) -> str:
    each = timing.skew_s
    return timing.skew_reason or (
        f"RMS {number(1e3 * each.rms)} ms, p99 {number(1e3 * each.p99)} ms, max {number(1e3 * each.most)} ms"
    )


_SENT_COLUMNS: Final[list[Column[Parity]]] = [
    Column("compared", "targets", lambda each: each.compared),
    Column("equal in every bit", "targets", lambda each: each.equal),
    Column("largest difference", "rad", lambda each: f"{each.most_rad:.2g}"),
]


def _sent_differences(found: Comparison) -> list[str]:
    words = []
    for name, arm in _arms(found):
        each = arm.sent
        if each.first is not None:
            words.append(f"{name}: the first that differs is number {each.first[1]} of episode {each.first[0]}")
        if each.later:
            words.append(f"{name}: run B's targets were taken {each.later} ticks later, as its actions act later")
    return words
