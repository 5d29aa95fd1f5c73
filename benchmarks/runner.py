"""Measure two arms moved through `ur_rtde` on the emulated cell: stops, timing, accuracy, tasks.

python benchmarks/runner.py [--parts stops,kills,sine,e_series,busy,carry,handover] [--family cb3] [--latency TICKS]
    [--share 1.0] [--json FILE]

All parts take more than an hour; `--share 0.05` gives a first impression. Part `e_series` is `sine` on two e-Series
controllers at 500 Hz, part `busy` is `sine` while simulations like those of a training fill all cores; their figures
have a key of their own. Figures of time depend on the other work of the machine: its load is printed beside them. If
the machine stalls for longer than the latency of an action allows, the action misses its deadline and both arms stop:
40 ms leave about 10 ms, so tasks use 80 ms here.
"""

import argparse
import contextlib
import itertools
import json
import math
import os
import pathlib
import random
import signal
import subprocess
import sys
import tempfile
import time

import gymnasium as gym
import numpy as np

from dual_ur10 import policies
from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.emulated.emulated_cell import EmulatedCell
from dual_ur10.errors import CellFaulted, LinkError, StartError
from dual_ur10.policies import evaluate, rollout
from dual_ur10.sim2real.analysis.timing import timing
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.runtime.arm_memory import Phase
from dual_ur10.sim2real.runtime.arm_sender import STOP_RAD_S2
from dual_ur10.sim2real.runtime.latch import Latch
from dual_ur10.sim2real.runtime.runner import Runner
from ur_core.kinematics.ur10 import TICK_S

ARMS = ("left", "right")
LATENCY_TICKS = 10
TRIALS, KILLS, SECONDS, EPISODES = 200, 100, 600.0, 20
CODES = (3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 99, 255)
SPEED_RAD_S = 0.3
STOPPED = (CellFaulted, LinkError, StartError)

IMPORTED_S = 10.0  # until the trainings beside run

TRAINING = """
import sys
import gymnasium as gym
import dual_ur10
env = gym.make_vec("DualUR10/SineTracking-v0", num_envs=16)
env.reset(seed=int(sys.argv[1]))
env.action_space.seed(int(sys.argv[1]))
while True:
    env.step(env.action_space.sample())
"""

KILLED = """
import sys, time
import numpy as np
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.runtime.runner import Runner
sys.path.insert(0, sys.argv[2])
from runner import Swing
file = load_cell_file(sys.argv[1])
runner = Runner(file, file.config())
swing = Swing(runner)
print("moving", runner.arms[0].name, *(each.process.pid for each in (*runner.processes, runner.supervisor)))
sys.stdout.flush()
while True:
    swing.feed()
    time.sleep(0.05)
"""


class Swing:
    """Oscillation of joints of both arms of a runner, towards home, because every stop leaves them elsewhere."""

    def __init__(self, runner):
        self.runner, self.home = runner, np.array([each.q_rad for each in runner.statuses()])
        self.amplitude = np.where(self.home > HOME_Q_RAD, -1.0, 1.0) * np.array([1.0, 0, 0, 1.0, 1.0, 1.0])
        runner.begin(self.home)
        self.first = runner.next
        self.done = 0
        self._written = []

    def feed(self, ahead=150):
        """Write targets ahead."""
        runner = self.runner
        count = max(0, runner.next + ahead - self.first - self.done)
        if count:
            ticks = self.done + np.arange(count)
            phase_rad = 2 * math.pi * ticks * runner.tick_s
            swung_rad = SPEED_RAD_S / (2 * math.pi) * (1 - np.cos(phase_rad)) * np.minimum(ticks * runner.tick_s, 1.0)
            targets = self.home + swung_rad[:, None, None] * self.amplitude
            runner.write(self.first + self.done, targets)
            self._written.append(targets)
            self.done += count

    def written(self, arm):
        """Return all targets of an arm, (k, 6)."""
        return np.concatenate(self._written)[:, arm]


def ready(cell):
    """Wait until both arms can start, from any state."""
    for arm in ARMS:
        for mode in CODES:
            cell.ask("release", arm=arm, mode=mode)
        state = cell.ask("state", arm=arm, names=["robot_mode"])["robot_mode"]
        if state != 7:
            cell.wait_until(arm, "safety_mode", 1)
            cell.ask("press", arm=arm, button="power_on")
            cell.wait_until(arm, "robot_mode", 5)
            cell.ask("press", arm=arm, button="release_brakes")
        for name, value in (("robot_mode", 7), ("safety_mode", 1), ("runtime_state", 1)):
            cell.wait_until(arm, name, value)


class SpoiledError(Exception):
    """Raised when this machine stalled in a trial, which is then void."""


class Spoiled:
    """Counter of trials that are repeated, because both arms were stopped or could not start.

    A machine that stalls for 0.1 s causes that; other causes are printed and counted, too.

    Args:
        path: The cell file.
        cell: The emulated cell.
        most: Largest tolerated number.
    """

    def __init__(self, path, cell, most):
        self.count = 0
        self._cell, self._latch, self._most = cell, Latch(load_cell_file(path)), most
        self.begin()

    def note(self, error):
        """Count one, and prepare the next trial."""
        self.count += 1
        print(f"\nspoiled: {error}", file=sys.stderr)
        if self.count > self._most:
            raise SystemExit("this machine is too busy: its arms stop by themselves") from error
        self.begin()

    def begin(self):
        """Prepare both arms for a start, from any state."""
        ready(self._cell)
        self._latch.clear()


def stop(file, cell, code, stopped, swing_s):
    """Return the control periods from a stop of one arm to the last target of the other's motion, by its controller.

    A stop takes effect in a control period; targets that reach the other controller before its next one count as 1.

    Args:
        file: The cell.
        cell: The emulated cell.
        code: Safety mode of the stop.
        stopped: Index of the stopped arm.
        swing_s: Time for which both move before.

    Raises:
        SpoiledError: This machine stalled.
    """
    try:
        runner = Runner(file, file.config())
    except STOPPED as error:
        raise SpoiledError(error) from error
    try:
        swing = Swing(runner)
        end = time.monotonic() + swing_s
        while time.monotonic() < end:
            swing.feed()
            time.sleep(0.02)
        if any(each.phase >= Phase.STOPPING for each in runner.arms):
            # A machine that stalls for 0.1 s stops both arms before the trial does.
            raise SpoiledError(runner.arms[stopped].text)
        other = ARMS[1 - stopped]
        before = cell.ask("received", arm=other, since=1 << 40)["motion"]
        cell.ask("stop", arm=ARMS[stopped], mode=code)
        begin = cell.ask("received", arm=ARMS[stopped], since=1 << 40)["stop_tick"]
        end = time.monotonic() + 2.0
        while time.monotonic() < end and any(each.phase < Phase.STOPPED for each in runner.arms):
            time.sleep(0.005)
        # Targets of a slowed motion lie between two planned ones.
        planned = {tuple(each) for each in swing.written(1 - stopped).tolist()}
        packages = cell.packages(other, max(0, before - 20))
        moved = [tick for tick, _, target in packages if tuple(target) in planned]
        if not moved:
            raise SpoiledError("time was lost, so that the sent targets lay between planned ones")
        last = max(moved)
        late = cell.ask("info")["late_ticks"]
        if any(begin - 2 <= tick <= last + 2 for tick in late):
            raise SpoiledError("the emulated controllers were late")
        return max(0, last - begin + 1)
    finally:
        runner.close()


def stops(path, cell, trials):
    """Measure stops over all codes and both arms."""
    found, spoiled = [], Spoiled(path, cell, max(3, trials // 5))
    rng = random.Random(0)
    chosen = itertools.cycle(itertools.product(CODES, range(len(ARMS))))
    file = load_cell_file(path)
    code, stopped = next(chosen)
    while len(found) < trials:
        spoiled.begin()
        try:
            found.append(stop(file, cell, code, stopped, 0.4 + 0.5 * rng.random()))
        except SpoiledError as error:
            spoiled.note(error)
            continue
        code, stopped = next(chosen)
        print(f"\rstops {len(found)} of {trials}: {found[-1]} periods ", end="", file=sys.stderr)
    spoiled.begin()
    return {
        "stop_cycles_p99": float(np.percentile(found, 99)),
        "stop_cycles_max": float(max(found)),
        "stop_trials": len(found),
        "stops_spoiled": spoiled.count,
    }


def kills(path, cell, trials):
    """Measure the time from SIGKILL, of the program or of all processes, to both programs and both arms stopped."""
    rng = random.Random(1)
    stopped, resting = {"program": [], "all": []}, {"program": [], "all": []}
    spoiled, trial = Spoiled(path, cell, max(3, trials // 5)), 0
    while trial < trials:
        spoiled.begin()
        folder = str(pathlib.Path(__file__).parent)
        program = subprocess.Popen([sys.executable, "-c", KILLED, str(path), folder], stdout=subprocess.PIPE, text=True)
        line = program.stdout.readline().split()
        time.sleep(0.4 + 0.5 * rng.random())
        states = [cell.ask("state", arm=arm, names=["runtime_state"])["runtime_state"] for arm in ARMS]
        if not line or states != [2, 2]:
            program.kill()
            program.wait()
            for pid in map(int, line[2:]):
                wait_for_end(pid)
            spoiled.note(SpoiledError(f"the arms that were to move had stopped: programs' states {states}"))
            continue
        kind = ("program", "all")[trial % 2]
        pids = [program.pid, *(map(int, line[2:]) if kind == "all" else ())]
        begin = time.monotonic()
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
        at = {}
        while len(at) < 4 and time.monotonic() - begin < 3.0:
            for arm in ARMS:
                state = cell.ask("state", arm=arm, names=["runtime_state", "target_qd"])
                if state["runtime_state"] != 2:
                    at.setdefault((arm, "stopped"), time.monotonic() - begin)
                if np.abs(state["target_qd"]).max() < 1e-4 and (arm, "stopped") in at:
                    at.setdefault((arm, "resting"), time.monotonic() - begin)
        stopped[kind].append(max(at.get((arm, "stopped"), math.inf) for arm in ARMS))
        resting[kind].append(max(at.get((arm, "resting"), math.inf) for arm in ARMS))
        program.wait()
        for pid in map(int, line[2:]):
            wait_for_end(pid)
        trial += 1
        text = f"{1e3 * stopped[kind][-1]:.0f} ms, at rest {1e3 * resting[kind][-1]:.0f} ms"
        print(f"\rkills {trial} of {trials}, {kind}: {text} ", end="", file=sys.stderr)
    spoiled.begin()
    both = [*stopped["program"], *stopped["all"]]
    return {
        "kill_to_stop_ms_max": 1e3 * max(both),
        **{f"kill_{kind}_to_stop_ms_max": 1e3 * max(times) for kind, times in stopped.items() if times},
        **{f"kill_{kind}_to_rest_ms_max": 1e3 * max(times) for kind, times in resting.items() if times},
        "kill_speed_rad_s": SPEED_RAD_S,
        "kill_trials": len(both),
        "kills_spoiled": spoiled.count,
    }


def wait_for_end(pid):
    """Wait until a process has ended."""
    end = time.monotonic() + 5.0
    while time.monotonic() < end:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.01)


@contextlib.contextmanager
def training(count=None):
    """Fill `count` cores, or all, with the simulations of a training, from a session of its own as in another terminal.

    Args:
        count: Number of simulations; None: one for each core.
    """
    busy = [
        subprocess.Popen([sys.executable, "-c", TRAINING, str(seed)], start_new_session=True)
        for seed in range((os.cpu_count() or 1) if count is None else count)
    ]
    try:
        time.sleep(IMPORTED_S if busy else 0.0)
        yield
    finally:
        for each in busy:
            each.kill()
            each.wait()


def sine(path, cell, folder, seconds, latency, *, lagging=False):
    """Measure timing and accuracy of SineTracking, and, if wanted, for a short while without compensated lag."""
    figures = {}
    for name, compensate, length_s in (("", True, seconds), ("_lagging", False, 30.0))[: 1 + lagging]:
        keywords = {"cell": str(path), "compensate_lag": compensate, "action_latency_ticks": latency}
        runs = folder / f"sine{name}"
        errors, late_actions, done_s = [], 0, 0.0
        spoiled = Spoiled(path, cell, max(3, round(length_s / 15.0)))
        while done_s < length_s:
            env = stopped = None
            try:
                env = gym.make("DualUR10/SineTracking-v0", record=str(runs), disable_env_checker=True, **keywords)
                policy = policies.load("scripted", "DualUR10/SineTracking-v0", **keywords)
                while done_s < length_s:
                    begin = time.monotonic()
                    errors.append(rollout(env, policy, seed=len(errors)).flange_error_m)
                    done_s += time.monotonic() - begin
                    print(f"\rsine{name}: {done_s:.0f} of {length_s:.0f} s ", end="", file=sys.stderr)
            except STOPPED as error:
                stopped = error
            finally:
                if env is not None:
                    late_actions += env.unwrapped.core.late_actions
                    env.close()
            if stopped is not None:
                spoiled.note(stopped)
        error = np.concatenate(errors)
        figures |= {
            f"sine{name}_rms_mm": 1e3 * float(np.sqrt((error**2).mean(axis=0)).max()),
            f"sine{name}_p99_mm": 1e3 * float(np.percentile(error, 99)),
            f"sine{name}_max_mm": 1e3 * float(error.max()),
            f"sine{name}_episodes": len(errors),
            f"sine{name}_late_actions": late_actions,
            f"sine{name}_spoiled": spoiled.count,
        }
        if not name:
            figures |= times_of([read_run(each) for each in sorted(runs.iterdir())])
    return figures


def times_of(runs):
    """Return lateness and skew of the sent targets over runs, those of stopped episodes included."""
    found = [timing(run) for run in runs if run.episodes]
    late = [arm.late for each in found for arm in each.arms]
    counts = [each.late for each in late]
    sent = sum(each.targets + each.missed for each in late)
    skew_s = np.abs(np.concatenate([each.skews_s for each in found]))
    return {
        "late_2ms": sum(each[0] for each in counts) / sent,
        "late_8ms": sum(each[1] for each in counts) / sent,
        "late_max_ms": 1e3 * max(each.most_s for each in late),
        "missed_periods": sum(each.missed for each in late),
        "left_out": sum(each.missed for each in late) / sent,
        "skew_p99_ms": 1e3 * float(np.percentile(skew_s, 99)),
        "skew_max_ms": 1e3 * float(skew_s.max()),
        "targets": sent,
    }


def task(path, cell, name, episodes, latency):
    """Run scripted episodes of a task with an object, and repeat those in which both arms were stopped."""
    found, late_actions, spoiled = [], 0, Spoiled(path, cell, max(3, episodes))
    while len(found) < episodes:
        keywords = {"cell": str(path), "action_latency_ticks": latency}
        try:
            each = evaluate(
                f"DualUR10/{name}-v0", "scripted", episodes=1, seed=len(found), num_envs=1, env_kwargs=keywords
            )
        except STOPPED as error:
            spoiled.note(error)
            continue
        found += each.episodes
        late_actions += each.late_actions
        if not (episode := each.episodes[0]).success:
            print(f"\nfailed: seed {episode.seed}, {each.late_actions} late: {episode.ended_by}", file=sys.stderr)
        print(f"\r{name} {len(found)} of {episodes} ", end="", file=sys.stderr)
    successes = sum(each.success for each in found)
    part = {"SyncCarry": "carry", "Handover": "handover"}[name]
    figures = {part: f"{successes} of {len(found)}", f"{part}_late_actions": late_actions}
    figures[f"{part}_spoiled"] = spoiled.count
    for value in ("relative_error_m", "squeeze_n", "object_error_m"):
        peaks = [each.peak[value] for each in found if value in each.peak]
        if peaks:
            figures[f"{part}_{value}_max"] = float(np.max(peaks))
    return figures


GOALS = {
    "stop_cycles_p99": 2.0,
    "stop_cycles_max": 3.0,
    "kill_to_stop_ms_max": 150.0,
    "kill_program_to_rest_ms_max": 150.0 + 1e3 * SPEED_RAD_S / STOP_RAD_S2,
    "kill_all_to_rest_ms_max": 150.0 + 1e3 * SPEED_RAD_S / STOP_RAD_S2,
    "late_2ms": 0.01,
    "late_8ms": 0.001,
    "skew_p99_ms": 1.0,
    "sine_rms_mm": 0.5,
}
"""Largest value that a figure should have. They are not enforced: a busy machine misses them."""

GOALS_OF = {
    "e_series": {"left_out": 0.001, "skew_p99_ms": 0.5, "sine_rms_mm": 0.15},
    "busy": {"late_2ms": 0.005, "skew_p99_ms": 2.0, "sine_rms_mm": 0.3},
}
"""The same for the parts whose figures have a key of their own."""


def goal(part, key, value):
    """Return the goal of a figure, and whether it is reached."""
    most = GOALS_OF.get(part, GOALS).get(key)
    if most is None:
        return ""
    return f"goal: at most {most:g}, {'reached' if value <= most else 'MISSED'}"


def some(most, fraction):
    """Return a fraction of a number, at least two."""
    return max(2, round(most * fraction))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", default="stops,kills,sine,e_series,busy,carry,handover")
    parser.add_argument("--share", type=float, default=1.0, help="of trials, seconds and episodes")
    parser.add_argument("--family", choices=tuple(TICK_S), default="cb3", help="of both controllers")
    parser.add_argument("--latency", type=int, default=LATENCY_TICKS, help="action latency of tasks, in ticks of 8 ms")
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()
    figures = {}
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        os.environ["XDG_STATE_HOME"] = name
        for part in args.parts.split(","):
            load = os.getloadavg()[0]
            found = measure(part, folder, "e-series" if part == "e_series" else args.family, args.latency, args.share)
            print(file=sys.stderr)
            found |= {"load": load, "load_after": os.getloadavg()[0]}
            for key, value in found.items():
                text = f"{value:.4g}" if isinstance(value, float) else str(value)
                print(f"{part:9} {key:28} {text:16} {goal(part, key, value)}".rstrip(), flush=True)
            if part in GOALS_OF:
                figures[part] = found
            else:
                figures |= {f"{part}_{key}" if key.startswith("load") else key: value for key, value in found.items()}
            if args.json:  # after every part: a later one may find the machine too busy
                args.json.parent.mkdir(parents=True, exist_ok=True)
                args.json.write_text(json.dumps(figures, indent=1))


def measure(part, folder, family, latency_ticks, share):
    """Measure one part on an emulated cell of its own, whose plant is "mild": it deviates from the nominal model."""
    scene = {"carry": "SyncCarry", "handover": "Handover"}.get(part, "SineTracking")
    path, runs = folder / f"{part}.toml", folder / f"{part}_runs"
    latency = round(latency_ticks * TICK_S["cb3"] / TICK_S[family])
    with contextlib.ExitStack() as stack:
        cell = stack.enter_context(EmulatedCell(task=scene, cell=str(path), family=family))
        for arm in ARMS:
            cell.wait_until(arm, "robot_mode", 7)
        if part == "stops":
            return stops(path, cell, some(TRIALS, share))
        if part == "kills":
            return kills(path, cell, some(KILLS, share))
        if part in ("carry", "handover"):
            return task(path, cell, scene, some(EPISODES, share), latency)
        runs.mkdir()
        if part == "busy":
            stack.enter_context(training())
        return sine(path, cell, runs, max(30.0, SECONDS * share), latency, lagging=part == "sine")


if __name__ == "__main__":
    main()
