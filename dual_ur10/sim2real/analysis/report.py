"""A comparison as one HTML file with everything in it."""

from __future__ import annotations

import importlib.util
import math
import re
from html import escape
from pathlib import Path
from typing import Final

from dual_ur10 import __version__
from dual_ur10.cli.demo_report.report_sine import CLAIMS
from dual_ur10.errors import MissingExtraError
from dual_ur10.files import write_text
from dual_ur10.kinematics.ur10 import ARMS, JOINTS
from dual_ur10.sim2real.analysis.compare import ArmComparison, Comparison, Differences
from dual_ur10.sim2real.analysis.page import Headers, image, lead, note, number, page, table, text, tiles
from dual_ur10.sim2real.analysis.series import Spread, Value
from dual_ur10.sim2real.analysis.timing import LATE_S, MOVING_M_S, RIPPLE_WINDOW_S, ArmTiming, Timing
from dual_ur10.sim2real.recording.run import Header

SOURCE_RIPPLE_M_S: Final = 0.03
"""What the documents that this project started from allow a flange's speed to fluctuate by."""

_SOURCES: Final = {
    "mujoco": "simulated in MuJoCo",
    "emulated": "emulated controllers, no arms",
    "real": "real arms",
}

_SPREADS: Final = (("RMS", ""), ("p99", ""), ("max", ""))

Row = tuple[str, str, list[str]]


def write_report(path: str | Path, found: Comparison, names: tuple[str, str] = ("run A", "run B")) -> None:
    """Write the report.

    Args:
        path: The file.
        found: What is to be told.
        names: What the recordings are called.

    Raises:
        DualUR10Error: The file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    write_text(path, report(found, names))


def check_extra() -> None:
    """Make sure that figures can be drawn: before, not after, runs are read.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise MissingExtraError("matplotlib", "plot", "the report of a comparison")


def report(found: Comparison, names: tuple[str, str] = ("run A", "run B")) -> str:
    """The report as HTML; see `write_report`."""
    check_extra()
    from dual_ur10.sim2real.analysis import plots as drawings

    body = "\n".join(
        (
            _head(found, names),
            _tiles(found),
            _caveats(found),
            "<h2>The runs</h2>",
            _runs(found, names),
            text("Distance of each flange from where it began, in the first episode."),
            image(drawings.paths(found), "Distance of each flange from its start in both runs"),
            "<h2>Flanges</h2>",
            _flanges(found),
            image(drawings.flange_error(found), "Distance between the flanges of both runs over time"),
            image(drawings.flange_vector(found), "Vector between the flanges of both runs along x, y and z"),
            "<h3>The figures this project started from</h3>",
            _claims(found),
            "<h2>Joints</h2>",
            _joints(found),
            text("The same over time, in the first episode."),
            image(drawings.joint_errors(found), "Differences of the joints over time"),
            "<h2>Timing</h2>",
            _timing(found),
            "<h3>Skew</h3>",
            image(drawings.skew(found), "Histogram of the time between sendings to both arms"),
            "<h2>What was sent</h2>",
            _sent(found),
            "<footer>Written by <code>python -m dual_ur10 compare</code>.</footer>",
        )
    )
    title = escape(f"{names[0]} and {names[1]} compared")
    return re.sub("<title>.*?</title>", lambda _: f"<title>{title}</title>", page(body), count=1)


def _head(found: Comparison, names: tuple[str, str]) -> str:
    header = found.headers[0]
    return (
        f"<header><h1>Two runs of {escape(header.env_id)}</h1>"
        f"<p class='sub'>A: {escape(names[0])} · B: {escape(names[1])} · dual-ur10 {escape(__version__)}</p></header>"
    )


def _tiles(found: Comparison) -> str:
    lags = [each.lag.value for each in found.arms if not each.lag.reason]
    free = [each.free.flange_m for each in found.arms if each.free is not None]
    equal, compared = (sum(getattr(each.sent, name) for each in found.arms) for name in ("equal", "compared"))
    return tiles(
        (
            (_mm(max((each.rms for each in free), default=math.nan)), "flange A to B, RMS, lag taken off", "main"),
            (
                _mm(max(each.found.flange_m.rms for each in found.arms)),
                "the same with the lag",
                "",
            ),
            (
                f"{number(1e3 * max(lags, key=abs, default=math.nan))} ms",
                "B behind A, the arm where it is more",
                "",
            ),
            (f"{equal} of {compared}", "targets equal in every bit, both arms", "main" if equal == compared else ""),
        )
    )


def _mm(value_m: float) -> str:
    return f"{number(1e3 * value_m)} mm"


def _caveats(found: Comparison) -> str:
    kinds = sorted({each.source for each in found.headers})
    points = [
        "<b>Nothing here was measured from outside.</b> Flange poses are computed from measured joints by each run's "
        "own kinematics: what a calibration has wrong, and how links bend, is in no figure.",
    ]
    if "real" not in kinds:
        points.append("<b>No real arm is in this comparison.</b> Emulated controllers are software, like simulation.")
    points += [f"{escape(each[:1].upper() + each[1:])}." for each in found.notes]
    return note("What these figures are, and are not", points)


def _runs(found: Comparison, names: tuple[str, str]) -> str:
    def row(title: str, values: tuple[object, object]) -> Row:
        return title, "", [str(each) for each in values]

    a, b = found.headers
    rows = [
        row("recording", names),
        row("what moved", (_SOURCES.get(a.source, a.source), _SOURCES.get(b.source, b.source))),
        row("begun", (a.started_utc, b.started_utc)),
        row("policy", (a.policy or "—", b.policy or "—")),
        row("its sha256", (_short(a.policy_sha256), _short(b.policy_sha256))),
        row("replays", (_replays(a), _replays(b))),
        row("controllers", (_rate(a), _rate(b))),
        row("servoj", (_profile(a), _profile(b))),
        row("speed factor", (f"{a.speed_factor:g}", f"{b.speed_factor:g}")),
        row("action latency in ticks", (a.latency_ticks, b.latency_ticks)),
        row("seed", ("—" if a.seed is None else a.seed, "—" if b.seed is None else b.seed)),
        row("version", (a.versions.get("dual_ur10", "—"), b.versions.get("dual_ur10", "—"))),
        row("recorded to the end", ("yes" if found.complete[0] else "no", "yes" if found.complete[1] else "no")),
    ]
    return table("runs", (("run A", ""), ("run B", "")), rows)


def _short(sha256: object) -> str:
    return f"{sha256[:16]}…" if isinstance(sha256, str) and sha256 else "—"


def _replays(header: Header) -> str:
    """Which run it plays again."""
    told = header.extra.get("replays")
    if not isinstance(told, dict):
        return "—"
    return f"episode {told.get('episode')} of {told.get('run')}, {_short(told.get('sha256'))}"


def _rate(header: Header) -> str:
    return f"{header.family}, {1 / header.tick_s:g} Hz, an action every {header.period_ticks} ticks"


def _profile(header: Header) -> str:
    each = header.servoj[0]
    return f"lookahead {each['lookahead_s']:g} s, gain {each['gain']:g}"


def _flanges(found: Comparison) -> str:
    headers: Headers = (
        ("RMS", "mm"),
        ("p99", "mm"),
        ("max", "mm"),
        ("x RMS", "mm"),
        ("y RMS", "mm"),
        ("z RMS", "mm"),
        ("x mean", "mm"),
        ("y mean", "mm"),
        ("z mean", "mm"),
        ("angle max", "°"),
    )
    rows: list[Row] = []
    for name, arm in zip(ARMS, found.arms, strict=True):
        rows.append((f"{name}, as it is", "", _flange(arm.found)))
        if arm.free is not None:
            rows.append((f"{name}, {number(1e3 * arm.lag.value)} ms lag off", "ours", _flange(arm.free)))
    dashes = ["—"] * 7
    rows.append(("left − right, as it is", "", [*_spread(found.vector_m, 1e3), *dashes]))
    rows.append(("left − right, lags off", "ours", [*_spread(found.vector_free_m, 1e3), *dashes]))
    reasons = [f"{name}: {arm.lag.reason}" for name, arm in zip(ARMS, found.arms, strict=True) if arm.lag.reason]
    why = f" No lag is known of {escape('; '.join(reasons))}." if reasons else ""
    return table("flanges", headers, rows) + text(
        "Run A minus run B at equal times of the task. Last rows: the vector from the right flange to the left one; "
        "what both arms do wrong alike shows in neither. Lag: by how much B is behind A, by the cross-correlation of "
        f"all six joints of an arm and a parabola through its peak.{why}"
    )


def _flange(each: Differences) -> list[str]:
    axes = [number(1e3 * axis.rms) for axis in each.flange_axes_m]
    mean = [number(1e3 * float(value)) for value in each.flange_mean_m]
    return [*_spread(each.flange_m, 1e3), *axes, *mean, number(math.degrees(each.turn_rad.most))]


def _spread(each: Spread, scale: float) -> list[str]:
    return [number(scale * value) for value in each]


def _claims(found: Comparison) -> str:
    units = (("position", "mm"), ("orientation", "°"), ("flange distance", "m"), ("control period", "ms"))
    rows: list[Row] = [(title, "weak", list(cells)) for title, *cells in CLAIMS]
    tick = " / ".join(dict.fromkeys(f"{1e3 * each.tick_s:g}" for each in found.headers))
    for title, each in (("as it is", _worst(found, free=False)), ("lag taken off", _worst(found, free=True))):
        rows.append((f"these runs, A to B, {title}", "ours", [*each, "—", tick]))
    rows.append(("speed of a flange may fluctuate by", "weak", [f"± {1e3 * SOURCE_RIPPLE_M_S:g} mm/s", "—", "—", "—"]))
    for name, timing in zip("AB", found.timing, strict=True):
        most = max((each.ripple.size_m_s.p99 for each in timing.arms if not each.ripple.reason), default=math.nan)
        rows.append((f"run {name}: speed ripple, p99", "ours", [f"{number(1e3 * most)} mm/s", "—", "—", "—"]))
    return table("claims", units, rows) + text(
        "Grey: as stated by the documents that this project started from, without trials, payload or path; they name "
        "a laser tracker, which cannot measure Gazebo, and periods of 2.1 to 2.5 ms, which a CB3 controller with its "
        "8 ms does not have. Theirs are errors of a pose, ours differences between two runs: beside each other are "
        "numbers only. Largest differences of the worse arm."
    )


def _worst(found: Comparison, *, free: bool) -> list[str]:
    each = [arm.free if free else arm.found for arm in found.arms]
    known = [one for one in each if one is not None]
    if len(known) < len(each):
        return ["—", "—"]
    position = 1e3 * max(one.flange_m.most for one in known)
    return [number(position), number(math.degrees(max(one.turn_rad.most for one in known)))]


def _joints(found: Comparison) -> str:
    headers = [(f"{name} {what}", "mrad") for name in ARMS for what, _ in _SPREADS]
    rows: list[Row] = []
    for joint, name in enumerate(JOINTS):
        title = name.removesuffix("_joint").replace("_", " ")
        as_is, free = ([_joint(arm, joint, free=each) for arm in found.arms] for each in (False, True))
        rows.append((f"{title}, as it is", "", as_is[0] + as_is[1]))
        rows.append((f"{title}, lag taken off", "ours", free[0] + free[1]))
    return table("joints", headers, rows)


def _joint(arm: ArmComparison, joint: int, *, free: bool) -> list[str]:
    each = arm.free if free else arm.found
    return ["—"] * 3 if each is None else _spread(each.joints_rad[joint], 1e3)


def _timing(found: Comparison) -> str:
    limits = [f"{1e3 * each:g} ms" for each in LATE_S]
    headers: Headers = (
        ("behind targets", "ms"),
        ("targets", ""),
        *((f"later than {each}", "%") for each in limits),
        ("latest", "ms"),
        ("missed", "periods"),
        ("ripple RMS", "mm/s"),
        ("ripple p99", "mm/s"),
        ("ripple max", "mm/s"),
        ("start pose max", "mm"),
        ("start pose ISO", "mm"),
    )
    rows: list[Row] = []
    reasons: list[str] = []
    for run, timing in zip("AB", found.timing, strict=True):
        for name, arm in zip(ARMS, timing.arms, strict=True):
            rows.append((f"run {run}, {name}", "", _arm_timing(arm)))
            for what, reason in (
                ("lag behind its targets", arm.behind.reason),
                ("ripple", arm.ripple.reason),
                ("repeatability", arm.repeatability.reason),
            ):
                if reason:
                    reasons.append(f"run {run}, {name}, no {what}: {escape(reason)}")
    skews = "; ".join(f"run {run}: {_skew(timing)}" for run, timing in zip("AB", found.timing, strict=True))
    why = f" Why figures are missing: {'; '.join(dict.fromkeys(reasons))}." if reasons else ""
    return (
        lead(f"Skew between the arms' sends of the same target — {skews}.")
        + table("timing", headers, rows)
        + text(
            "Behind targets: measured joints behind what was sent, by cross-correlation, on the run's clock. Ripple: "
            "length of the difference between a flange's velocity (central differences of positions, one control "
            f"period to either side) and the cubic that fits {RIPPLE_WINDOW_S:g} s of it, while the flange moves "
            f"faster than {1e3 * MOVING_M_S:g} mm/s. Start pose: spread of the flange after each reset; ISO: mean "
            f"distance from their mean plus three standard deviations, from three episodes on.{why}"
        )
    )


def _arm_timing(arm: ArmTiming) -> list[str]:
    late = arm.late
    return [
        _value(arm.behind, 1e3),
        str(late.targets),
        *(number(100 * share) for share in late.shares),
        number(1e3 * late.most_s),
        str(late.missed),
        *_spread(arm.ripple.size_m_s, 1e3),
        number(1e3 * arm.repeatability.most_m),
        number(1e3 * arm.repeatability.iso_m),
    ]


def _value(each: Value, scale: float) -> str:
    return number(scale * each.value)


def _skew(timing: Timing) -> str:
    if timing.skew_reason:
        return escape(timing.skew_reason)
    each = timing.skew_s
    return f"RMS {number(1e3 * each.rms)} ms, p99 {number(1e3 * each.p99)} ms, max {number(1e3 * each.most)} ms"


def _sent(found: Comparison) -> str:
    headers = (("compared", "targets"), ("equal in every bit", "targets"), ("largest difference", "rad"))
    rows: list[Row] = []
    words = []
    for name, arm in zip(ARMS, found.arms, strict=True):
        each = arm.sent
        rows.append((name, "", [str(each.compared), str(each.equal), f"{each.most_rad:.2g}"]))
        if each.first is not None:
            words.append(f"{name}: the first that differs is number {each.first[1]} of episode {each.first[0]}")
        if each.later:
            words.append(f"{name}: run B's targets were taken {each.later} ticks later, as its actions act later")
    return table("sent", headers, rows) + text(
        "Targets with the same number in both runs. Those that were sent between two, because time was slowed down, "
        f"are left out. {escape('. '.join(words))}{'.' if words else ''}"
    )
