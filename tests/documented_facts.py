"""Facts that pages state, each with its one source: a table of measurements, a card of a policy, or the code.

`SOURCES` finds measurements by a pattern whose groups name them, `constants` reads the code, and `STATEMENTS` are the
sentences of other pages, with the facts' names in braces. After a new measurement edit the source; the test then
names each sentence that is left behind, with the values that it must state.
"""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
CARDS = "dual_ur10/policies/learned/learned_policies"
README = "README.md"
BENCHMARKS = "docs/reference/benchmarks.md"
BENCHMARKS_METHOD = "docs/reference/benchmarks-method.md"
TRUE_ERRORS = "docs/decisions/true-errors-count.md"
TRAIN = "docs/tutorials/train.md"
RUN_AND_STOP = "docs/how-to/run-and-stop.md"
STOPS = "docs/reference/stops.md"
CONTROL = "docs/explanation/control.md"
ENVIRONMENTS = "docs/reference/environments.md"

SOURCES = [
    (BENCHMARKS, r"^\| perturbed \| \S+ mm \| (?P<perturbed_rms>\S+) mm \| (?P<perturbed_angle>\S+)°"),
    (BENCHMARKS, r"^\*Random plants\*[^*]*\*\*(?P<carried>\d+ of \d+)\*\* episodes succeed"),
    (BENCHMARKS, r"^\| known \| (?P<handed_known>\d+ of \d+) \|"),
    (BENCHMARKS, r"^\| noisy \| (?P<handed>\d+ of \d+) \|[^|]*\| (?P<handed_s>\S+) /"),
    (TRUE_ERRORS, r"^\| wide \| (?P<wide_script>\d+ of \d+) \| (?P<wide_script_mm>\d\.\d\d)"),
    (TRUE_ERRORS, r"^\| mild \| (?P<mild_script>\d+ of \d+) \| (?P<mild_script_mm>\d\.\d\d)"),
    (TRUE_ERRORS, r"^\| wide, bases and age as in mild \| \*\*(?P<wide_known>\d+ of \d+)\*\*"),
    (
        BENCHMARKS,
        r'^- SineTracking, "wide", default path: (?P<wide_learned>(?P<wide_one>\d+) and (?P<wide_two>\d+)) of 300',
    ),
    (
        BENCHMARKS,
        r"^- PPO from scratch, SineTracking \([^)]*\): success in (?P<ppo_sine>\d+ of \d+) episodes with each, "
        r"\d+ % of the return, (?P<ppo_minutes>\S+ to \S+) minutes",
    ),
    (
        BENCHMARKS,
        r"^- PPO from scratch, Handover \([^)]*\): "
        r"success in (?P<ppo_handover>(?P<ppo0>\d+), (?P<ppo1>\d+) and (?P<ppo2>\d+) of \d+), "
        r"lifted in (?P<lifted0>\d+), (?P<lifted1>\d+) and (?P<lifted2>\d+) %, "
        r"handed over in (?P<handed0>\d+), (?P<handed1>\d+) and (?P<handed2>\d+) %, "
        r"placed in (?P<placed0>\d+), (?P<placed1>\d+) and\s+(?P<placed2>\d+) %. "
        r"[\s\S]*? million steps and (?P<ppo0_min>\d+), (?P<ppo1_min>\d+) and (?P<ppo2_min>\d+) minutes",
    ),
    (
        BENCHMARKS,
        r"^- PPO from scratch, SyncCarry \([^:]*\): success in (?P<ppo_carry>\d+ of \d+) with each [^;]*; "
        r"(?P<carry0>\d+), (?P<carry1>\d+) and (?P<carry2>\d+) minutes",
    ),
    (
        BENCHMARKS,
        r"^- Stock Stable-Baselines3, SineTracking, the README's [^)]*\): success in "
        r"(?P<stock>(?P<stock0>\d+), (?P<stock1>\d+) and (?P<stock2>\d+) of 100) episodes, [^%]*% of the return, "
        r"flange errors of (?P<stock_mm>(?P<stock0_mm>\S+), (?P<stock1_mm>\S+) and (?P<stock2_mm>\S+)) mm, after "
        r"\S+ steps and "
        r"(?P<stock0_min>\S+), (?P<stock1_min>\S+) and (?P<stock2_min>\S+) minutes",
    ),
    (BENCHMARKS, r"^- Twenty demonstrations, .*: (?P<twenty>\d+ of \d+) .* in (?P<twenty_minutes>\S+) minutes"),
    (BENCHMARKS, r"^\| one arm stops: .* \| (?P<stop>\d+) cycles \| (?P<stop_busy>\d+) cycles \|"),
    (BENCHMARKS, r"^\| program killed: both arms are at rest .* \| (?P<killed>\d+) ms \| (?P<killed_busy>\d+) ms \|"),
    (BENCHMARKS, r"^\| sine, flange .* \| (?P<streamed>\S+) mm \| (?P<streamed_busy>\S+) mm \|"),
    (BENCHMARKS, r"^`gym.make_vec`[\s\S]*?^\| SineTracking, scripted \| \S+ \| (?P<steps_s>\S+) \|"),
    (BENCHMARKS, r"^\| TwoArmLift; SyncCarry \|[^|]*\|[^(]*\((?P<least_peer>\S+) times\)"),
    (BENCHMARKS, r"^\| TwoArmHandover; Handover \|.*\((?P<most_peer>\S+) times\) \|$"),
    (BENCHMARKS, r"^\| ±2π, elbow ±π \|.*\| (?P<inverse_batch>\S+) µs \| (?P<inverse_single>\S+) µs \|$"),
]


_ROW = r"^\| (?:default \| )?{}[^|]*\| (?P<{}>\d+) of 300 \| (?P<{}_ci>[^|]+?) \|"


def _of_card(folder: str, name: str) -> list[tuple[str, str]]:
    """Return the sources in the card of a policy; `name` begins the names of its facts."""
    patterns = [
        rf"^\| made with \|.* (?P<{name}_min>\d+) minutes",
        _ROW.format(r'random \("mild"\)', *[f"{name}_mild"] * 2),
        _ROW.format("nominal", *[f"{name}_nominal"] * 2),
    ]
    if name in ("sine", "agents"):
        patterns += [
            rf'^\| random \| random \("mild"\) \| (?P<{name}_paths>\d+) of 300',
            rf'^\| default \| random \("mild"\) \|.*\| (?P<{name}_mild_mm>\S+) mm',
            rf"^\| default \| nominal \|.*\| (?P<{name}_nominal_mm>\S+) mm",
        ]
    elif name != "lid":
        patterns += [_ROW.format(r'random \("wide"\)', *[f"{name}_wide"] * 2)]
    if name != "handover":
        patterns += [rf"^\| made with \|.* (?P<{name}_memory>\S+ GiB)"]
    else:  # its command gives another policy now
        again = r"(?P<again_wide>\d+) \(wide\), (?P<again_mild>\d+) \(mild\) and (?P<again_nominal>\d+) \(nominal\)"
        patterns += [rf"^\| seed \|.* the command gave .* {again}"]
    return [(f"{CARDS}/{folder}/card.md", each) for each in patterns]


SOURCES += _of_card("sine_tracking", "sine") + _of_card("sine_tracking_two_agents", "agents")
SOURCES += _of_card("sync_carry", "carry") + _of_card("handover", "handover")
SOURCES += _of_card("tray_balance", "tray") + _of_card("lid_and_place", "lid")


def measured() -> dict[str, str]:
    """Return the facts of `SOURCES`.

    Raises:
        LookupError: Sources do not match their patterns.
    """
    facts: dict[str, str] = {}
    for source, pattern in SOURCES:
        found = re.search(pattern.replace(" ", r"\s+"), (ROOT / source).read_text(), re.MULTILINE)
        if found is None:
            raise LookupError(f"{source} states nothing of this form; adapt it, or remove its sentences: {pattern}")
        facts |= {name: " ".join(each.split()) for name, each in found.groupdict().items()}
    minutes = sorted(int(facts[f"{name}_min"]) for name in ("sine", "agents", "carry", "handover", "tray", "lid"))
    return facts | {"least_min": str(minutes[0]), "most_min": str(minutes[-1])}


def constants() -> dict[str, str]:
    """Return the facts of the code."""
    from dual_ur10.assets.collision_model import clearance_pairs
    from dual_ur10.assets.props import BAR
    from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
    from dual_ur10.envs.core.setup import load_task
    from dual_ur10.envs.tasks.observation_layout import ConciseView
    from dual_ur10.ids import ENV_IDS
    from dual_ur10.sim2real.cell import cell_config
    from dual_ur10.sim2real.control import cartesian_step, clearance, coupling, gate, proximity
    from dual_ur10.sim2real.runtime import (
        approach,
        arm_process,
        arm_sender,
        path_to_start,
        runner,
        safety_monitor,
        tracking,
    )
    from ur_core.kinematics import ur10
    from ur_core.kinematics.robots import ROBOTS
    from ur_core.servoj import TICK_S

    facts = {"models": f"{len(ROBOTS)}"}
    for env_id in ENV_IDS:
        task, short = load_task(env_id), env_id.partition("/")[2].partition("-")[0]
        settings = task.settings_type()
        arm = task.layout_for(settings).size
        view = ConciseView(task.layout_for(settings), HOME_Q_RAD, short)
        sizes = {"arm": arm, "both": 2 * arm, "goals": 2 * view.layout.size}
        facts |= {f"{short}_{name}": f"{each}" for name, each in sizes.items()}
        facts[f"{short}_rad_s"] = f"{max(task.limits.speed_rad_s):.1f}"
    for family, tick_s in TICK_S.items():
        name = family.replace("-", "_")
        facts[f"{name}_least_ticks"] = f"{runner.least_latency_ticks(tick_s)}"
        facts[f"{name}_margin_ticks"] = f"{runner.margin_ticks(tick_s)}"
        facts[f"{name}_ticks"] = f"{round(cell_config.LATENCY_S / tick_s)}"
    for name, equipment in (
        ("bare", Equipment()),
        ("gripper", Equipment(grippers=True)),
        ("payload", Equipment(grippers=True, props=(BAR,))),
    ):
        facts[f"{name}_pairs"] = f"{len(clearance_pairs(SceneSettings(equipment=equipment)))}"
    facts["payload_adds"] = f"{int(facts['payload_pairs']) - int(facts['gripper_pairs'])}"
    shapes = re.search(
        r"enum Shape {(.*)}", (ROOT / "packages" / "ur-core" / "ur_core" / "kernel" / "distances.hpp").read_text()
    )
    for number, shape in enumerate(re.findall(r"\w+(?= =)", shapes[1] if shapes else "")):
        facts[f"shape{number}"] = shape.lower()
    return facts | {
        "latency_ms": f"{1e3 * cell_config.LATENCY_S:g}",
        "margin_ms": f"{1e3 * runner.MARGIN_S:g}",
        "policy_ms": f"{1e3 * safety_monitor.POLICY_S:g}",
        "apart_mm": f"{1e3 * coupling.APART_M:g}",
        "apart_deg": f"{coupling.APART_RAD * 180 / 3.141592653589793:g}",
        "reduced": {0.5: "half"}[safety_monitor.REDUCED_SCALING],
        "stale_ms": f"{1e3 * arm_sender.STALE_S:g}",
        "gap_mrad": f"{1e3 * arm_sender.START_GAP_RAD:g}",
        "watchdog_hz": f"{arm_process.WATCHDOG_HZ:g}",
        "approach_rad_s": f"{approach.SPEED_RAD_S:g}",
        "approach_m_s": f"{approach.TCP_SPEED_M_S:g}",
        "settle_s": f"{path_to_start._SETTLE_S:g}",
        "settled_rad": f"{path_to_start.SETTLED_RAD:.0e}".replace("e-0", "e-"),
        "start_mrad": f"{1e3 * path_to_start.START_RAD:g}",
        "measured_rad": f"{path_to_start.MEASURED_RAD:g}",
        "hot_c": f"{tracking.HOT_C:g}",
        "deviation_rad": f"{tracking.DEVIATION_RAD:g}",
        "deviation_states": {3: "three"}[tracking._ROWS],
        "near_mm": f"{1e3 * proximity.NEAR_M:g}",
        "least_scaling": {1 / 8: "an eighth"}[proximity.LEAST_SCALING],
        "clear_mm": f"{1e3 * clearance.MINIMUM_M:g}",
        "above_mm": f"{1e3 * (proximity.NEAR_M - clearance.MINIMUM_M):g}",
        "sweep_mm": f"{1e3 * gate.SWEEP_TOLERANCE_M:g}",
        "slow_condition": f"{cartesian_step.SLOW_CONDITION:g}",
        "halt_condition": f"{cartesian_step.HALT_CONDITION:g}",
        "hard_rad_s2": f"{ur10.HARD_ACCELERATION_RAD_S2:g}",
        "hard_rad_s3": f"{ur10.HARD_JERK_RAD_S3:,g}",
        "hard_m_s": f"{ur10.HARD_TCP_SPEED_M_S:g}",
    }


STATEMENTS = [
    # Sizes of observations.
    (README, "follow the same sine, synchronously | {SineTracking_both} numbers, 12 joint steps |"),
    (README, "carry it along a path and put it down | {SyncCarry_both} numbers, 14 with two grippers |"),
    (README, "hands it to the other, which places it | {Handover_both} numbers, 14 with two grippers |"),
    (README, "any two of [{models} models]"),
    ("docs/index.md", "any two of [{models} models]"),
    (
        "docs/tutorials/first-environment.md",
        "holds {SineTracking_arm} numbers of the left arm, then {SineTracking_arm} of the right one",
    ),
    (ENVIRONMENTS, "Instead of {SineTracking_both} to {SyncCarry_both} numbers"),
    (ENVIRONMENTS, "it has {SineTracking_goals} to {Handover_goals}, each float32"),
    # Constants of the code.
    (
        RUN_AND_STOP,
        "| default of L | {latency_ms} ms ({cb3_ticks} ticks) | {latency_ms} ms ({e_series_ticks} ticks) |",
    ),
    (RUN_AND_STOP, "| smallest L | {cb3_least_ticks} ticks | {e_series_least_ticks} ticks |"),
    (
        RUN_AND_STOP,
        "ahead by | {margin_ms} ms ({cb3_margin_ticks} ticks) | {margin_ms} ms ({e_series_margin_ticks} ticks) |",
    ),
    (RUN_AND_STOP, "| more than {policy_ms} ms after its deadline |"),
    (STOPS, "the policy is late by more than {policy_ms} ms"),
    (STOPS, "a joint is more than {deviation_rad} rad from its target for {deviation_states} states"),
    (STOPS, "a joint is above {hot_c} °C"),
    (STOPS, "no new RTDE timestamp for {stale_ms} ms"),
    (STOPS, "the arm was moved by more than {gap_mrad} mrad before the first target"),
    (STOPS, "the relative pose of the arms is off by more than {apart_mm} mm or {apart_deg}°"),
    (RUN_AND_STOP, "arms a watchdog there ({watchdog_hz} Hz)"),
    (RUN_AND_STOP, "with at most {approach_rad_s} rad/s, and {approach_m_s} m/s at flange, elbow and TCP"),
    (RUN_AND_STOP, "within {settle_s} s its target settles to {settled_rad} rad"),
    (RUN_AND_STOP, "is tolerated up to {start_mrad} mrad, and it is measured within {measured_rad} rad"),
    (RUN_AND_STOP, "while two bodies approach each other within {near_mm} mm, to {least_scaling} at least"),
    (RUN_AND_STOP, "the task's clock runs at {reduced} its rate"),
    (CONTROL, "closed forms of {shape0}s, {shape1}es and {shape2}s"),
    (CONTROL, "{bare_pairs} pairs cover every contact"),
    (CONTROL, "{gripper_pairs} with grippers, {payload_pairs} with payload geometry. At least {clear_mm} mm"),
    (CONTROL, "It adds {payload_adds} pairs"),
    (CONTROL, "at most {sweep_mm} mm remain uncovered"),
    (CONTROL, "within its last {above_mm} mm"),
    (CONTROL, "its bounds, {slow_condition} and {halt_condition},"),
    (CONTROL, "joint speeds, {hard_rad_s2} rad/s², {hard_rad_s3} rad/s³ and {hard_m_s} m/s"),
    (CONTROL, "SineTracking {SineTracking_rad_s} rad/s, SyncCarry {SyncCarry_rad_s} rad/s"),
    # Measurements.
    (README, "RMS {perturbed_rms} mm, {perturbed_angle}° with wrong masses, friction and delays; through `ur_rtde` on"),
    (README, "emulated arms RMS {streamed} mm, {streamed_busy} mm when the machine is busy |"),
    (
        README,
        "{sine_paths} of 300 episodes (sine, on any path), {carry_mild} of 300 (carry), {handover_mild} of 300",
    ),
    (
        README,
        "(handover), {tray_mild} of 300 (tray), {lid_mild} of 300 (lid); {least_min} to {most_min} min of training |",
    ),
    (
        README,
        "{steps_s} steps/s. In a second of processor time, {least_peer} to {most_peer} times as many simulated seconds",
    ),
    (README, "{stop} control periods later in all 200 trials, at most {stop_busy} when the machine is busy."),
    (README, "both at rest after at most {killed} ms, {killed_busy} ms when busy |"),
    (README, "does not succeed in every handover: {ppo_handover} |"),
    (
        README,
        "succeeds in {stock} unseen episodes, with flange errors of {stock_mm} mm. A training takes {stock2_min} min",
    ),
    ("docs/how-to/train-your-own.md", "{stock} episodes. A training takes {stock2_min} minutes with a core to itself"),
    (README, "succeeds in {wide_script} episodes (scripted) and {wide_learned} of 300 (learned)"),
    (README, 'so that only the rest is "wide": {wide_known} (scripted)'),
    ("docs/decisions/own-inverse-kinematics.md", "ours takes {inverse_single} µs and {inverse_batch} µs since the"),
    # Trainings, and the policies of the package.
    (TRAIN, "the policies of the package took {least_min} to {most_min} minutes"),
    (TRAIN, 'On "wide" plants they succeed in {wide_learned} of 300 episodes'),
    *((TRAIN, f"| {{lifted{seed}}} % | {{handed{seed}}} % | {{placed{seed}}} % |") for seed in range(3)),
    *((TRAIN, f"| {{carry{seed}}} min |") for seed in range(3)),
    (TRAIN, "| {twenty} | {twenty_minutes} |"),
    (TRAIN, "succeeds in {again_mild} (mild), {again_nominal} (nominal) and {again_wide} (wide) of 300 episodes"),
    (BENCHMARKS_METHOD, "gave {again_mild} (mild), {again_nominal} (nominal) and {again_wide} (wide)"),
    ("docs/explanation/learnable-tasks.md", "{handover_wide} of 300, and in {handover_mild} of 300 under"),
]
for row, label, name in (
    ("| `learned` | SineTracking |", "`learned`", "sine"),
    ("| `learned-two-agents` | SineTracking, one network per arm |", "`learned-two-agents`", "agents"),
):
    STATEMENTS += [
        (
            TRAIN,
            f"{row} {{{name}_mild}} / {{{name}_nominal}} | {{{name}_mild_mm}} / {{{name}_nominal_mm}} mm | "
            f"{{{name}_min}} min, {{{name}_memory}} |",
        ),
        (
            BENCHMARKS,
            f"| {label} | mild | {{{name}_mild}} of 300 | {{{name}_mild_ci}} | {{{name}_mild_mm}} mm | "
            f"{{{name}_min}} min, {{{name}_memory}} |",
        ),
        (BENCHMARKS, f"| {label} | mild, random path | {{{name}_paths}} of 300 |"),
        (
            BENCHMARKS,
            f"| {label} | nominal | {{{name}_nominal}} of 300 | {{{name}_nominal_ci}} | {{{name}_nominal_mm}} mm |",
        ),
    ]
STATEMENTS += [
    (TRAIN, '| SyncCarry; on "wide" plants {carry_wide}, too | {carry_mild} / {carry_nominal} |'),
    (TRAIN, "| {carry_mild} / {carry_nominal} | | {carry_min} min, {carry_memory} |"),
    (TRAIN, '| Handover, trained on "wide" plants; there {handover_wide} | {handover_mild} / {handover_nominal} |'),
    (TRAIN, "| {handover_mild} / {handover_nominal} | | {handover_min} min |"),
    (
        TRAIN,
        '| TrayBalance, `tcp_delta`; on "wide" plants {tray_wide} | {tray_mild} / {tray_nominal} | | {tray_min} min, '
        "{tray_memory} |",
    ),
    (TRAIN, "| LidAndPlace, `tcp_delta` | {lid_mild} / {lid_nominal} | | {lid_min} min, {lid_memory} |"),
    (BENCHMARKS, "| `learned` | mild | {carry_mild} of 300 | {carry_mild_ci} | {carry_min} min, {carry_memory} |"),
    (BENCHMARKS, "| `learned` | wide | {carry_wide} of 300 | {carry_wide_ci} | | | PPO"),
    (BENCHMARKS, "| `learned` | mild | {handover_mild} of 300 | {handover_mild_ci} | {handover_min} min |"),
    (BENCHMARKS, "| `learned` | nominal, pose known | {handover_nominal} of 300 | {handover_nominal_ci} | |"),
    (BENCHMARKS, "| `learned` | wide | {handover_wide} of 300 | {handover_wide_ci} | | | PPO"),
    # The other baselines, measured elsewhere.
    (BENCHMARKS, "| `scripted` | mild | {mild_script} | 98.7 to 100 % | {mild_script_mm} mm |"),
    (BENCHMARKS, "| `scripted` | wide | {wide_script} | 34.3 to 45.3 % | {wide_script_mm} mm |"),
    (BENCHMARKS, "| `scripted` | mild | {carried} | 98.7 to 100 % | – |"),
    (BENCHMARKS, "| `scripted` | nominal, pose known | {handed_known} |"),
    (BENCHMARKS, "| `scripted` | nominal, pose noisy | {handed} |"),
    (BENCHMARKS, "| `learned` | wide | {wide_one} of 300 |"),
    (BENCHMARKS, "| `learned-two-agents` | wide | {wide_two} of 300 |"),
    (BENCHMARKS, "| nominal | {ppo_sine} | 98.7 to 100 % | – | {ppo_minutes} min |"),
    (BENCHMARKS, "| nominal | {ppo_carry} | 96.3 to 100 % | {carry0}, {carry1} and {carry2} min |"),
    *((BENCHMARKS, f"seed {seed} | nominal | {{ppo{seed}}} of 300 |") for seed in range(3)),
    *((BENCHMARKS, f"% | {{ppo{seed}_min}} min |") for seed in range(3)),
    *((BENCHMARKS, f"seed {seed} | nominal | {{stock{seed}}} of 100 |") for seed in range(3)),
    *((BENCHMARKS, f"% | {{stock{seed}_mm}} mm | {{stock{seed}_min}} min |") for seed in range(3)),
    (BENCHMARKS, "| imitation of twenty demonstrations | wide | {twenty} | 84.2 to 91.5 % | {twenty_minutes} min |"),
]
