"""The command line, as a user meets it."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import os
import re
import signal
import subprocess
import sys
import tomllib
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import typer
from rich.console import Console

from dual_ur10 import ENV_IDS, __version__
from dual_ur10.cli import main as cli_main
from dual_ur10.cli import options as cli_options
from dual_ur10.cli import session as cli_session
from dual_ur10.emulated.virtual_cell import VirtualCell
from dual_ur10.envs.core.setup import load_task
from dual_ur10.errors import MissingExtraError, SettingsError
from dual_ur10.policies.baselines import BASELINES
from dual_ur10.policies.operators.catalog import DEVICES
from dual_ur10.policies.registry import NAMES, shipped_names
from dual_ur10.sim2real.recording import run_folder
from tests.cli.command import run
from ur_core.kinematics.robots import ROBOTS
from ur_core.processes.interrupts import INTERRUPTED
from ur_core.tools.tool import tool_names

WAIT_S = 60.0
SHORT = ("--set", "duration_s=0.4")


@pytest.fixture(autouse=True)
def _somewhere_else(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run in another folder: runs are recorded in the current one."""
    monkeypatch.chdir(tmp_path)


def test_commands_that_only_move_run_on_a_virtual_cell_of_their_task(monkeypatch: pytest.MonkeyPatch) -> None:
    from dual_ur10 import testing

    def made(**options: Any) -> None:
        raise SettingsError(f"a virtual cell with {options}")

    monkeypatch.setattr(testing, "VirtualCell", made)
    assert run("rollout", "SineTracking", "-n", "1", *SHORT)[0] == 0
    (recorded,) = Path("runs").iterdir()
    assert "a virtual cell with {'task': None}" in run("repeatability", "--cell", "virtual")[1]
    text = run("replay", str(recorded), "--cell", "virtual", "--no-record")[1]
    assert "a virtual cell with {'task': 'DualUR10/SineTracking-v0', 'settings': {'duration_s': 0.4}}" in text
    for command in ("rollout", "evaluate"):
        text = run(
            command, "PegInsertion", "--cell", "virtual", "--set", "clearance_m=0.0005", "--set", "at_limits=lead"
        )[1]
        assert "with {'task': 'DualUR10/PegInsertion-v0', 'settings': {'clearance_m': 0.0005}}" in text


def test_list_names_every_environment_with_its_sizes_and_its_task() -> None:
    code, text = run("list")
    assert code == 0
    lines = text.splitlines()
    for env_id in ENV_IDS:
        row, below = next(lines[k : k + 2] for k, line in enumerate(lines) if env_id in line)
        sizes = {"SineTracking": ["12", "94"], "SyncCarry": ["14", "170"], "Handover": ["14", "158"]}
        for task, (action, observation) in sizes.items():
            if task in env_id:
                learned = [f"{name}," for name in shipped_names(row.split()[0])]
                assert row.split()[1:] == ["25", "Hz", action, observation, "scripted,", *learned, "random,", "zero"]
        assert below.strip() == (load_task(env_id).__doc__ or "").partition("\n")[0]


def test_list_names_policies_devices_grippers_and_robots_with_a_line_of_each() -> None:
    lines = [line for line in run("list")[1].splitlines() if line]
    groups = {"policy": [*NAMES, *BASELINES], "device": DEVICES, "gripper": tool_names(), "robot": ROBOTS}
    for title, names in groups.items():
        begin = next(k for k, line in enumerate(lines) if line.split() == [title]) + 1
        rows = [line.split(maxsplit=1) for line in lines[begin : begin + len(names)]]
        assert [name for name, _ in rows] == [*names]
        assert min(len(what.split()) for _, what in rows) >= 3
    assert "ur10     UR10: cb3, reach 1.3 m, payload 10 kg" in [line.rstrip() for line in lines]
    assert "robotiq_2f85  Robotiq 2F-85: stroke 85 mm, up to 235 N, 0.925 kg" in [line.rstrip() for line in lines]
    assert any(line.split() == ["gamepad", "Gamepad", "for", "one", "hand."] for line in lines)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ((), ("list", "rollout", "view", "--version")),
        (("list",), ("environments",)),
        (("rollout",), ("ENV", "--policy", "--episodes", "--seed", "--set", "--perturbed", "KEY=VALUE")),
        (("view",), ("ENV", "--policy", "--seconds", "browser")),
        (
            ("convert",),
            ("MODEL", "ENV", "--out", "--trust-pickle", "--vec-normalize", "--algo", "--agents", "KEY=VALUE"),
        ),
    ],
)
def test_help_lists_commands_and_options(command: tuple[str, ...], words: tuple[str, ...]) -> None:
    code, text = run(*command, "--help")
    assert code == 0
    for word in words:
        assert word in text
    assert "<bool>" not in text  # flags take no value


def test_version() -> None:
    assert run("--version") == (0, __version__ + "\n")


def test_neither_the_version_nor_a_typo_waits_for_the_commands() -> None:
    code = """
import contextlib, sys
from dual_ur10.cli.main import app
for arguments in (["--version"], ["rollot"]):
    with contextlib.suppress(SystemExit):
        app(arguments)
print(sorted(each for each in sys.modules if each.startswith(("dual_ur10.cli.", "mujoco", "viser", "torch", "scipy"))))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=WAIT_S, check=True)
    assert done.stdout.splitlines() == [__version__, "['dual_ur10.cli.main', 'dual_ur10.cli.options']"]
    assert "Did you mean 'rollout'" in done.stderr


@pytest.mark.parametrize("name", ["DualUR10/SineTracking-v0", "SineTracking-v0", "SineTracking"])
def test_rollout_prints_a_row_per_episode_and_a_summary(name: str) -> None:
    code, text = run("rollout", name, "-n", "2", "--seed", "4", *SHORT)
    assert code == 0
    rows = [line.split("│")[1:-1] for line in text.splitlines() if line.startswith("│")]
    assert [[cell.strip() for cell in row[:3]] for row in rows] == [["0", "4", "10"], ["1", "5", "10"]]
    assert all(row[4].strip() == "yes" and float(row[5]) < 0.1 for row in rows)
    assert "success 2 of 2" in text
    (recorded,) = Path("runs").iterdir()
    assert text.splitlines()[0] == f"recording in {recorded}"
    assert not logging.getLogger(run_folder.__name__).handlers  # not for what records later


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        ((), "interrupted"),
        (("--cell", "echo"), "interrupted"),
        (("--cell", "virtual"), "interrupted: both arms have stopped"),
    ],
)
def test_ctrl_c_keeps_the_rows_of_finished_episodes(
    cell: tuple[str, ...], words: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tired.py").write_text("""
import numpy as np

class Tired:
    def __init__(self): self.calls = 0
    def reset(self): pass
    def __call__(self, observation):
        self.calls += 1
        if self.calls == 25:
            raise KeyboardInterrupt
        return np.zeros(12, dtype=np.float32)
""")
    monkeypatch.syspath_prepend(tmp_path)
    code, text = run("rollout", "SineTracking", "-p", "tired:Tired", "-n", "200", "--no-record", *SHORT, *cell)
    sys.modules.pop("tired")
    assert code == INTERRUPTED
    assert [line.split()[1] for line in text.splitlines() if line.startswith("│")] == ["0", "1"]
    assert text.splitlines()[0] == words
    assert text.splitlines()[-1].endswith(" of 2; 200 were asked for")


def test_a_task_without_flange_errors_has_no_columns_of_them() -> None:
    _, text = run("rollout", "Handover", "-n", "1", "--policy", "zero", "--no-record", "--set", "duration_s=1.0")
    assert "recording" not in text
    assert "mm" not in text
    (row,) = [line.split("│")[1:-1] for line in text.splitlines() if line.startswith("│")]
    assert row[-1].strip() == "time"  # its end, which is not an early one


def test_set_reaches_the_environment_and_perturbed_the_plant() -> None:
    figures = []
    for more in ((), ("--perturbed",), ("--set", "compensate_lag=False"), ("--set", "policy_rate_hz=125")):
        code, text = run("rollout", "SineTracking", "-n", "1", "--set", "duration_s=1.2", *more)
        assert code == 0
        row = next(line for line in text.splitlines() if line.startswith("│")).split("│")
        figures.append((int(row[3]), float(row[7])))
    (steps, nominal), (_, perturbed), (_, lagging), (fast, _) = figures
    assert nominal < 0.01 < perturbed < lagging
    assert (steps, fast) == (30, 150)


@pytest.mark.parametrize("policy", ["random", "zero"])
def test_baseline_policies_run_and_fail(policy: str) -> None:
    code, text = run("rollout", "SineTracking", "-p", policy, "-n", "1", "--set", "duration_s=2")
    assert code == 0
    assert "success 0 of 1" in text


@pytest.mark.parametrize("command", ["rollout", "evaluate"])
@pytest.mark.parametrize(
    ("policy", "wanted", "expected", "last"),
    [
        ("zero", (), 0, "nothing succeeded: 0 of 2"),
        ("zero", ("--min-success", "0"), 0, "nothing succeeded: 0 of 2"),
        ("zero", ("--min-success", "0.5"), 1, "nothing succeeded: 0 of 2 are a rate of 0, required 0.5 or more"),
        ("scripted", ("--min-success", "1"), 0, None),
    ],
)
def test_the_last_line_and_the_exit_code_tell_that_nothing_succeeded(
    command: str, policy: str, wanted: tuple[str, ...], expected: int, last: str | None
) -> None:
    code, text = run(command, "SineTracking", "-p", policy, "-n", "2", "--set", "duration_s=2", *wanted)
    assert code == expected
    assert ("nothing succeeded" in text) == (last is not None)
    assert last is None or text.splitlines()[-1] == last


def test_too_few_successes_and_late_actions_are_told_apart(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as caught:
        cli_session.conclude(1, 4, 1, 0.5)
    assert caught.value.exit_code == 1
    text = capsys.readouterr().err
    assert text.startswith("too few successes: 1 of 4 are a rate of 0.25, required 0.5 or more; 1 late action stopped")
    assert "no decision of the policy: this machine is too busy" in text
    cli_session.conclude(1, 4, 3, None)  # its own line tells of them
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("command", ["rollout", "evaluate"])
def test_a_policy_that_cannot_be_loaded_leaves_no_folder_of_a_run(command: str, tmp_path: Any) -> None:
    code, text = run(command, "SineTracking", "--policy", "no_such_module:Policy", "--record", "here")
    assert (code, "No module named 'no_such_module'" in text) == (2, True)
    assert not (tmp_path / "here").exists()


def test_random_actions_depend_on_the_seed_alone() -> None:
    arguments = ("rollout", "SineTracking", "-p", "random", "-n", "1", "--no-record", *SHORT, "--seed")
    assert run(*arguments, "3") == run(*arguments, "3")
    assert run(*arguments, "3") != run(*arguments, "4")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("rollout", "SineTracking", "--set", "amplitud=0.1"),
            "unexpected keyword argument 'amplitud' (did you mean amplitude_m?): use one of",
        ),
        (("rollout", "SineTracking", "--set", "axis=w"), "unknown axis 'w'"),
        (("rollout", "SineTracking", "--set", "amplitude_m=much"), "amplitude_m is 'much': it must be a number"),
        (("rollout", "SineTracking", "--set", "policy_rate_hz=30"), "The neighbours are 25 Hz"),
        (("rollout", "SineTracking", "--set", "policy_rate_hz='x'"), "policy rate is 'x': it must be a number"),
        (("rollout", "SineTracking", "--set", "amplitude_m"), "write it as KEY=VALUE"),
        (("rollout", "SineTracking", "--set", "arms=left", "--set", "arms=both"), "arms is set twice"),
        (("rollout", "SineTracking", "--perturbed", "--set", "cell=mujoco"), "an option sets cell"),
        (("rollout", "SineTracking", *SHORT, "--record", "x" * 300), "File name too long: '"),
        (("replay", "x" * 300), "File name too long: '"),
        (("compare", "x" * 300, "y"), "File name too long: '"),
        (("import", "lerobot", "x" * 300), "File name too long: '"),
        (("rollout", "Juggling"), "unknown environment 'Juggling': use one of 'DualUR10/SineTracking-v0'"),
        (("rollout", "SineTracking", "-p", "psychic"), "unknown policy 'psychic': use one of 'scripted'"),
        (("rollout", "SineTracking", "--operator", "wheel"), "unknown operator 'wheel': use one of 'keyboard'"),
        (("rollout", "SineTracking", "--operator", "leader:port=3"), "unknown argument of the operator leader 'port'"),
        (("rollout", "SineTracking", "--operator", "keyboard", "-p", "zero"), "do not go together"),
        (("evaluate", "SineTracking", "--operator", "spacemouse:path=/none,scale=2"), "scale is 2"),
        (("rollout", "SineTracking", "--operator", "spacemouse:path=/none"), "there is no /none"),
        (
            ("view", "SineTracking", "--set", "amplitud=0.1"),
            "unexpected keyword argument 'amplitud'",
        ),
    ],
)
def test_a_bad_argument_is_one_line_and_exit_code_2(arguments: tuple[str, ...], message: str) -> None:
    code, text = run(*arguments)
    assert code == 2
    assert text.startswith("error: ")
    assert message in text
    assert text.count("\n") == 1
    assert "raised from" not in text


def test_an_error_of_the_system_that_stopped_both_arms_is_told_as_any_other(capsys: Any) -> None:
    """A policy that reads files or sockets raises such errors, whose notes say how to go on."""
    for error in (OSError("the link is gone"), FileNotFoundError(2, "No such file", "weights")):
        error.add_note("both arms were stopped: the policy failed. Check both")
        with pytest.raises(typer.Exit) as caught, cli_main.one_line_errors():
            raise error
        assert caught.value.exit_code == 2
        assert capsys.readouterr().err.splitlines()[-1].startswith("both arms were stopped")
    with pytest.raises(OSError, match="of no file"), cli_main.one_line_errors():
        raise OSError("of no file")


PERSON = """
import numpy as np
from dual_ur10.errors import DeviceUnpluggedError
from dual_ur10.policies.operators.device import Reading

OPEN = []


class Hand:
    name, hands = "a hand", 2

    def __init__(self, speed=0.0, buttons=""):
        self.speed, self.buttons = speed, [*str(buttons).split("+"), *[""] * 9999]
        OPEN.append(self)

    def begin(self):
        pass

    def read(self):
        pressed = frozenset(filter(None, [self.buttons.pop(0)]))
        if "interrupt" in pressed:
            raise KeyboardInterrupt
        if "unplug" in pressed:
            raise DeviceUnpluggedError("a hand was unplugged")
        return Reading(twist=np.full((2, 6), self.speed), clutch=np.array([True, True]), buttons=pressed)

    def close(self):
        OPEN.remove(self)
"""


@pytest.mark.parametrize("command", ["rollout", "evaluate"])
def test_a_person_with_a_device_of_ones_own_acts(command: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_hand.py").write_text(PERSON)
    monkeypatch.syspath_prepend(tmp_path)
    arguments = ("SineTracking", "-n", "1", "--set", "duration_s=0.2", "--operator")
    still, led = (run(command, *arguments, f"my_hand:Hand:speed={speed},arms=left") for speed in (0.0, 0.05))
    assert still[0] == led[0] == 0
    assert still[1] != led[1]
    code, text = run(command, *arguments, "my_hand:Hand", "--set", "amplitud=1")
    assert (code, "amplitud" in text) == (2, True)
    assert __import__("my_hand").OPEN == []
    sys.modules.pop("my_hand")


def test_a_person_takes_arms_from_a_policy_and_the_record_says_who_commanded(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dual_ur10.sim2real.recording.reader import read_run

    (tmp_path / "my_hand.py").write_text(PERSON)
    monkeypatch.syspath_prepend(tmp_path)
    hand = "my_hand:Hand:speed=0.05,buttons=+take_left++take_right+hand_back"
    arguments = ("SineTracking", "-n", "1", "--set", "duration_s=0.2", "--record", str(tmp_path / "runs"))
    code, text = run("rollout", *arguments, "--takeover", hand)
    assert code == 0
    assert "the left arm is taken" in text
    found = read_run(next((tmp_path / "runs").iterdir()))
    assert found.episodes[0].commander.tolist() == [[0, 0], [1, 0], [1, 0], [1, 1], [0, 0]]
    assert found.header.policy.startswith("scripted, takeover my_hand")
    code, text = run("rollout", *arguments, "--operator", hand)
    assert read_run(sorted((tmp_path / "runs").iterdir())[-1]).episodes[0].commander.all()
    assert run("rollout", *arguments, "--takeover", hand, "--operator", hand)[0] == 2
    assert run("rollout", *arguments, "--takeover", hand, "-p", "psychic")[0] == 2
    assert __import__("my_hand").OPEN == []
    sys.modules.pop("my_hand")


def test_what_a_person_keeps_is_a_dataset_also_after_ctrl_c(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    (tmp_path / "my_hand.py").write_text(PERSON)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    hand = "my_hand:Hand:speed=0.05,buttons=record+++success+record++interrupt"
    code, text = run("collect", "SineTracking", "--operator", hand, "--record", str(tmp_path / "runs"))
    assert code == INTERRUPTED
    assert "kept after 0.1 s (success); 1 kept, 0 s" in text
    assert "dual-ur10/sinetracking/operator-v0: 1 episodes, 2 steps" in " ".join(text.split())
    assert minari.load_dataset("dual-ur10/sinetracking/operator-v0").total_steps == 2
    code, text = run("collect", "SineTracking", "--operator", hand, "--record", str(tmp_path / "runs"))
    assert code == 2
    assert text.startswith("error: the dataset dual-ur10/sinetracking/operator-v0 exists, and nothing is overwritten")
    assert __import__("my_hand").OPEN == []
    sys.modules.pop("my_hand")


@pytest.mark.parametrize(
    ("presses", "code", "words"),
    [
        ("record+++discard+record++interrupt", INTERRUPTED, ["thrown away after 0.1 s (discard)", "nothing was kept"]),
        ("record+++success+unplug", 2, ["lost-v0: 1 episodes, 2 steps", "error: a hand was unplugged"]),
    ],
)
def test_what_was_kept_is_told_however_it_ends(
    presses: str, code: int, words: list[str], tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    (tmp_path / "my_hand.py").write_text(PERSON)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    named = ("--dataset", "lost-v0", "--record", str(tmp_path / "runs"))
    found, text = run("collect", "SineTracking", "--operator", f"my_hand:Hand:buttons={presses}", *named)
    assert (found, [each for each in words if each not in " ".join(text.split())]) == (code, [])
    assert __import__("my_hand").OPEN == []
    sys.modules.pop("my_hand")


def test_values_of_set_are_literals_or_text() -> None:
    found = cli_options.keywords_of(
        ["a=0.05", "b=(0, 1, 0)", "c=left", "d=None", "e=x=y", "f=[1", "g=False"], perturbed=False
    )
    assert found == {"a": 0.05, "b": (0, 1, 0), "c": "left", "d": None, "e": "x=y", "f": "[1", "g": False}
    found = cli_options.keywords_of(["a=false", "b=null", 'c={"x": [1, true]}', "d=NaN"], perturbed=False)
    assert found == {"a": False, "b": None, "c": {"x": [1, True]}, "d": "NaN"}
    with pytest.raises(SettingsError):
        cli_options.keywords_of(["1a=2"], perturbed=False)


def start_view(*more: str) -> subprocess.Popen[str]:
    pytest.importorskip("viser")
    env = os.environ | {"COLUMNS": "160"}
    page = ("--port", "0", "--cameras", "none", "--no-browser")
    command = [sys.executable, "-u", "-m", "dual_ur10", "view", "SineTracking", *page, *more]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env, start_new_session=True
    )


def test_view_serves_a_page_and_ctrl_c_ends_it_cleanly() -> None:
    process = start_view()
    try:
        assert process.stdout is not None
        first = process.stdout.readline()
        url: Any = re.search(r"http://127\.0\.0\.1:\d+/\?token=\S+", first)
        assert url, first
        with urllib.request.urlopen(url.group(), timeout=WAIT_S) as page:
            assert page.status == 200
        second = process.stdout.readline()
        assert second == "Whoever has this address may press its buttons. Ctrl-C ends it\n"
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does it: to everything in the foreground
        rest, _ = process.communicate(timeout=WAIT_S)
    finally:
        process.kill()
        process.wait()
    # The signal may come while the line above is being written, which then is written again.
    assert (process.returncode, rest.removeprefix(second)) == (0, "closed\n")


def test_view_ends_after_the_given_seconds() -> None:
    process = start_view("--seconds", "0.5")
    text, _ = process.communicate(timeout=WAIT_S)
    assert process.returncode == 0
    assert "Traceback" not in text


# Python runs this before the program: Ctrl-C comes while a module is searched.
AT = """
import os
import signal
import sys


class At:
    def find_spec(self, name, *_):
        if name == os.environ["INTERRUPT_AT"]:
            sys.meta_path.remove(self)
            signal.raise_signal(signal.SIGINT)


sys.meta_path.insert(0, At())
"""


@pytest.mark.parametrize(
    "module",
    [
        "pettingzoo",
        "gymnasium",
        "dual_ur10.__main__",
        "dual_ur10.cli.main",
        "typer",
        "mujoco",
        "dual_ur10.envs.core.core",
    ],
)
def test_ctrl_c_while_it_loads_is_one_line_and_code_130(module: str, tmp_path: Any) -> None:
    (tmp_path / "sitecustomize.py").write_text(AT)
    path = os.pathsep.join([str(tmp_path), *(each or os.getcwd() for each in sys.path)])
    done = subprocess.run(
        [sys.executable, "-m", "dual_ur10", "rollout", "SineTracking", "-n", "1", "--no-record", *SHORT],
        env={**os.environ, "PYTHONPATH": path, "INTERRUPT_AT": module},
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


def test_importing_the_package_leaves_ctrl_c_to_the_program() -> None:
    code = "import signal, dual_ur10; assert signal.getsignal(signal.SIGINT) is signal.default_int_handler"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=WAIT_S)


@pytest.mark.parametrize("command", [("rollout", "SineTracking", "-n", "1", *SHORT), ("follow", "--to", "home")])
def test_a_command_runs_on_a_virtual_cell_and_ends_it(
    command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rtde_control")
    from dual_ur10 import testing

    cells = []
    monkeypatch.setattr(testing, "VirtualCell", lambda **options: cells.append(VirtualCell(**options)) or cells[-1])
    code, text = run(*command, "--cell", "virtual")
    assert code == 0, text
    assert ("emulated cell" if command[0] == "rollout" else "the arms are there") in text
    (cell,) = cells
    assert cell._closed


@pytest.mark.parametrize(
    ("arguments", "lacking", "extras"),
    [
        (
            ("rollout", "SineTracking", "--operator", "gamepad", "--cell", "virtual"),
            ("sdl2", "greenlet"),
            "teleop,virtual",
        ),
        (
            ("live", "Handover", "--operator", "leader:port=x", "--cell", "lab.toml", "--command"),
            ("viser", "serial", "rtde_control"),
            "live,teleop,real",
        ),
        (
            ("live", "Handover", "--operator", "gamepad", "--cell", "lab.toml"),
            ("viser", "sdl2", "rtde_control"),
            "live,teleop",
        ),
        (("view", "Handover"), ("viser",), "live"),
        (("evaluate", "Handover", "--operator", "keyboard:window=true"), ("sdl2",), "teleop"),
        (("collect", "Handover", "--takeover", "page"), ("minari", "viser"), "data,live"),
        (
            ("train", "Handover", "--dataset", "x/y-v0", "--operator", "gamepad"),
            ("torch", "minari", "sdl2"),
            "train,data,teleop",
        ),
        (("compare", "a", "b"), ("mcap_ros2", "matplotlib"), "records,plot"),
        (("replay", "a", "--cell", "lab.toml"), ("mcap", "rtde_control"), "records,real"),
        (("repeatability", "--cell", "lab.toml"), ("rtde_control",), "real"),
        (("follow", "--to", "home", "--cell", "virtual"), ("greenlet",), "virtual"),
    ],
)
def test_all_extras_that_are_missing_are_asked_for_at_once(
    arguments: tuple[str, ...], lacking: tuple[str, ...], extras: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name in lacking else find(name, *more))
    code, text = run(*arguments)
    assert (code, text.count("\n")) == (2, 1)
    assert text.endswith(f'pip install "dual-ur10[{extras}]"\n')
    assert text.count(" needs ") == text.count(",", text.index("pip install")) + 1
    assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("cell", "needs"), [("lab.toml", True), ("cells/lab", True), ("echo", False), ("mujoco", False), ("mine", False)]
)
def test_only_cell_files_need_the_client_of_real_arms(cell: str, needs: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *_: None)
    with pytest.raises(MissingExtraError, match=r"\[real\]") if needs else contextlib.nullcontext():
        cli_options.check_extras(cell=Path(cell))
    cli_options.check_extras(cell=Path(cell), moves=False)


def test_extras_are_those_that_errors_and_the_package_name() -> None:
    root = Path(cli_options.__file__).parents[2]
    known = tomllib.loads((root / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert cli_options.PACKAGES.keys() <= known.keys()
    named = set()
    for path in (each for package in ("dual_ur10", "packages") for each in (root / package).rglob("*.py")):
        named |= set(re.findall(r'MissingExtraError\("([^"]+)", "([^"]+)"', path.read_text()))
    assert len(named) > 10
    assert {(package, extra) for package, extra in named if package not in cli_options.PACKAGES.get(extra, ())} == {
        ("example-robot-data", "meshes"),  # for a keyword, not for a command
        ("PyAV", "cameras"),  # for a key of a cell file
        ("dual-ur10", "emulator"),  # of the emulator's own command
        ("pin", "dynamics"),  # for functions of URScript
    }


def test_an_error_of_several_extras_keeps_a_note_on_python_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", (3, 13, 0))
    first = MissingExtraError("viser", "live", "the live page")
    both = MissingExtraError("ur_rtde", "real", "moving UR arms", [first])
    assert str(both) == (
        "the live page needs viser, and moving UR arms needs ur_rtde, which has wheels for Python 3.11 and 3.12 only, "
        'found 3.13. There: pip install "dual-ur10[live,real]"'
    )


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (("rollot",), "rollout"),
        (("cell", "chek"), "check"),
        (("rollout", "SineTracking", "--polcy", "x"), "--policy"),
        (("rollout", "handovr"), "DualUR10/Handover-v0"),
        (("rollout", "carry"), "DualUR10/SyncCarry-v0"),
        (("rollout", "SINETRACKING"), "DualUR10/SineTracking-v0"),
        (("rollout", "SineTracking", "-p", "lerned"), "learned"),
        (("rollout", "SineTracking", "--cell", "virtul"), "virtual"),
        (("rollout", "SineTracking", "--set", "action_mode=tcp_dleta"), "tcp_delta"),
        (("rollout", "SineTracking", "--set", "robot=UR10E"), "ur10e"),
        (("rollout", "SineTracking", "--set", "reward=spars"), "sparse"),
        (("rollout", "SineTracking", "--set", 'reward_weights={"positon": 1}'), "position"),
        (("rollout", "SineTracking", "--operator", "game"), "gamepad"),
        (("rollout", "SineTracking", "--operator", "leader:bud=3"), "baud"),
        (("evaluate", "SineTracking", "--randomization", "mld"), "mild"),
        (("evaluate", "SineTracking", "--cell", "lab.toml", "--arm", "lefft"), "left"),
        (("video", "SineTracking", "-o", "x.mp4", "--cameras", "frnt"), "front"),
        (("train", "SineTracking", "--algo", "dager"), "dagger"),
        (("train", "SineTracking", "--agents", "share"), "shared"),
        (("train", "SineTracking", "--algo", "ppo", "--hyperparameter", "gama=0.9"), "gamma"),
        (("follow", "--to", "hme"), "home"),
        (("emulate", "--robot", "ur16"), "ur16e"),
        (("emulate", "--plant", "nominl"), "nominal"),
        (("emulate", "--polyscope", "5.2.6"), "5.26"),
        (("emulate", "--family", "eseries"), "e-series"),
        (("emulate", "--task", "handovr"), "DualUR10/Handover-v0"),
        (("emulate", "--tool", "generic_14"), "generic_140"),
        (("emulate", "--task", "PegInsertion", "--set", "clearence_m=0.0005"), "clearance_m"),
        (("cell", "new", "lab.toml", "--kind", "rael"), "real"),
        (("teach", "x.csv", "--cell", "lab.toml", "--arm", "rigt"), "right"),
    ],
)
def test_misspelled_names_are_answered_with_the_nearest_one(arguments: tuple[str, ...], wanted: str) -> None:
    code, text = run(*arguments)
    assert code == 2
    hint = rf"([Dd]id you mean|Possible options:) '?{re.escape(wanted)}\b"
    assert re.search(hint, " ".join(text.split())), text


@pytest.mark.parametrize(
    ("module", "arguments", "doing"),
    [
        ("rollout", ("rollout", "SineTracking", "-n", "2", "--no-record", *SHORT), "episode 2 of 2"),
        ("evaluate", ("evaluate", "SineTracking", "-n", "2", *SHORT), "success 100.0 %"),
        ("doctor", ("repeatability", "--paths", "2", "--settle", "0"), "returning home"),
    ],
)
def test_a_terminal_sees_the_time_left(
    module: str, arguments: tuple[str, ...], doing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = Console(file=io.StringIO(), force_terminal=True, width=160)
    monkeypatch.setattr(f"dual_ur10.cli.{module}.console", screen)
    assert run(*arguments)[0] == 0
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", screen.file.getvalue())  # type: ignore[attr-defined]
    assert re.search(rf"{doing} \S* *100% 0:00:\d\d 0:00:00", shown), shown


@pytest.mark.parametrize(
    ("terminal", "cell", "shown"),
    [(True, None, True), (False, None, False), (True, "virtual", True), (True, "x", False)],
)
def test_a_bar_is_neither_in_files_nor_over_questions(terminal: bool, cell: str | None, shown: bool) -> None:
    console = Console(file=io.StringIO(), force_terminal=terminal)
    assert cli_options.progress_of(console, cli_session.asks(cell)).disable != shown


def test_all_commands_show_progress_in_the_same_way() -> None:
    folder = Path(cli_options.__file__).parent
    own = [path.name for path in folder.rglob("*.py") if re.search(r"\bProgress\(|\.status\(", path.read_text())]
    assert own == ["options.py"]
