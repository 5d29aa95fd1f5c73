"""Audit of tasks: each rule finds its fault alone, and the tasks of the package have none."""

import sys
from dataclasses import dataclass, replace
from importlib.resources import files
from string import Template
from types import ModuleType
from typing import ClassVar

import numpy as np
import pytest

from dual_ur10.errors import PolicyError, SettingsError, UnknownNameError, UnreachableError
from dual_ur10.ids import TASKS
from dual_ur10.policies import load
from dual_ur10.tasks import Equipment, Field, SceneRequirements, Wish, gaussian, register, stage, term
from dual_ur10.testing import audit
from tests.cli.command import run

ID, FAULTY = "Audit/ReachBoth-v0", "Audit/Faulty-v0"
MODULE = "audited_reach_both"


def of_template(env_id=ID, scripted=', scripted="ReachBothScript"'):
    """Import the task that `new-task` writes."""
    text = (files("dual_ur10.cli") / "task_template" / "init.py.txt").read_text()
    source = Template(text).substitute(name="ReachBoth", package=MODULE, env_id=env_id)
    module = sys.modules[MODULE] = ModuleType(MODULE)
    exec(compile(source.replace(', scripted="ReachBothScript"', scripted), MODULE, "exec"), module.__dict__)
    return module


@pytest.fixture
def reach(registries):
    yield of_template()
    del sys.modules[MODULE]


def found(report):
    return {(each.rule, each.subject) for each in report.above("note")}


def audited(task, script=None, **keywords):
    """Register a task with a script, by default its base's, and audit it."""
    module = sys.modules[MODULE]
    script = type("FaultyScript", (script or module.ReachBothScript,), {"task": task, "__module__": MODULE})
    task.__module__, task.__qualname__ = MODULE, "Faulty"
    module.Faulty, module.FaultyScript = task, script
    register(FAULTY, scripted=script)(task)
    return audit(FAULTY, quick=True, **keywords)


@pytest.mark.parametrize("name", [each for each in TASKS if TASKS[each].scripted])
def test_no_task_of_the_package_has_a_fault(name):
    report = audit(name, quick=True, seed=1)
    assert report.above("note") == ()
    judged = {each for each in report.successes if not each.startswith(("script", "still after"))}
    assert len(judged) >= 10
    honest = {each.subject for each in report.findings if "no cheat" in each.found or "Accepted" in each.remedy}
    assert [each for each in judged - honest if report.successes[each][0]] == []
    assert max(report.returns[each] for each in ("zero", "uniform", "normal")) <= 0.0805


def test_the_task_of_the_template_has_none(reach):
    report = audit(ID)
    assert found(report) == set()
    assert report.successes["script"] == (3, 3)
    assert report.returns["left arm alone"] == pytest.approx(0.5, abs=0.02)


def test_waiting_earns_nearly_as_much_as_success(reach):
    class Camping(reach.ReachBoth):
        def quality(self, now):
            return 0.5

    assert found(audited(Camping)) == {("camping", "income")}


def test_the_start_is_worth_much(reach):
    class Flat(reach.ReachBoth):
        @term(weight=0.1)
        def alive(self, distance_m):
            return np.ones(self.n)

    assert found(audited(Flat)) == {("returns", "zero"), ("returns", "uniform"), ("returns", "normal")}


def test_a_term_falls_when_its_successor_is_reached(reach):
    class Falls(reach.ReachBoth):
        @stage(weight=1.0)
        def reach(self, distance_m):
            near = gaussian(distance_m, 0.05)
            return distance_m.max(axis=1) <= 0.02, (near[:, 0], near[:, 1])

        @stage(weight=0.15)
        def stay(self, distance_m):
            return distance_m.max(axis=1) <= self.settings.tolerance_m, 0.0

        @term(weight=0.2)
        def hovering(self, distance_m):
            return (self.passed == 1).astype(float)

    assert found(audited(Falls)) == {("stages", "passing stay"), ("camping", "income")}  # one follows from the other


def test_numbers_of_the_action_move_nothing(reach):
    report = audit(ID, quick=True, arm="left")
    errors = [each for each in report.above("note") if each.rule == "actions"]
    assert [each.subject for each in errors] == [f"right number {joint}" for joint in range(6)]
    assert {each.severity for each in errors} == {"error"}


def test_what_grippers_do_is_not_observed(reach):
    class Unseen(reach.ReachBoth):
        @classmethod
        def requirements(cls, settings):
            return SceneRequirements(Equipment(grippers=True, props=reach.GOALS))

    class Opened(reach.ReachBothScript):
        def script(self, fields):
            for wish in super().script(fields):
                yield Wish(wish.q_rad, np.ones(2))

    report = audited(Unseen, Opened)
    expected = {("actions", "left gripper"), ("actions", "right gripper"), ("cheats", "grippers closed")}
    assert found(report) == expected
    unchanged = {each.subject for each in report.findings if "no cheat" in each.found}
    assert unchanged == {"grippers open"}


@pytest.mark.parametrize(
    ("field", "value"),
    [
        (Field("constant", 1, -1.0, 1.0, "-", "constant"), lambda state: np.full((len(state.q_rad), 2, 1), 0.3)),
        (Field("outside", 3, -1.0, 1.0, "-", "outside"), lambda state: 20.0 * state.qd_rad_s[..., :3]),
        (Field("large", 3, -9.0, 9.0, "m", "large", concise=(1e-3,)), lambda state: state.flange_m + 0.1),
    ],
)
def test_a_field_tells_nothing(reach, field, value):
    class Further(reach.ReachBoth):
        layout = type(reach.ReachBoth.layout)(*reach.ReachBoth.layout.fields, field)

        def observe(self, state, measured, commanded_q_rad):
            known = reach.ReachBoth.layout.split(super_of(self, reach).observe(state, measured, commanded_q_rad))
            return self.layout.join({**known, field.name: value(state)})

    assert found(audited(Further)) == {("observations", field.name)}


def super_of(task, reach):
    """Return the honest task in the state of a faulty one."""
    honest = object.__new__(reach.ReachBoth)
    honest.__dict__ = {**task.__dict__, "layout": reach.ReachBoth.layout}
    return honest


def test_one_arm_succeeds(reach):
    class Alone(reach.ReachBoth):
        @stage(weight=1.0)
        def reach(self, distance_m):
            near = gaussian(distance_m, 0.05)
            return distance_m[:, 0] <= self.settings.tolerance_m, (near[:, 0], near[:, 1])

    report = audited(Alone)
    assert ("cheats", "left arm alone") in found(report)
    assert ("cheats", "right arm alone") not in found(report)
    assert {each.rule for each in report.above("note")} == {"cheats"}


def test_a_range_changes_nothing(reach):
    @dataclass(frozen=True)
    class Settings(reach.ReachBothSettings):
        further_m: float = 0.1

    class Ignoring(reach.ReachBoth):
        settings_type = Settings
        sampled: ClassVar = ("range_m", "further_m")

    assert found(audited(Ignoring)) == {("randomization", "further_m")}


def test_every_episode_begins_alike(reach):
    class Alike(reach.ReachBoth):
        def start(self, rows, rngs):
            return super().start(rows, [np.random.default_rng(1) for _ in rngs])

    expected = {("randomization", "start"), ("observations", "goal_base_m"), ("cheats", "actions of another seed")}
    assert found(audited(Alike)) == expected


def test_spread_changes_nothing(reach):
    class Narrow(reach.ReachBoth):
        def start(self, rows, rngs):
            given, self.settings = self.settings, replace(self.settings, range_m=min(0.1, self.settings.range_m))
            begun = super().start(rows, rngs)
            self.settings = given
            return begun

    assert found(audited(Narrow)) == {("randomization", "object_spread")}


def test_everything_succeeds(reach):
    class Given(reach.ReachBoth):
        @stage(weight=1.0)
        def reach(self, distance_m):
            return np.ones(self.n, dtype=bool), 1.0

    report = audited(Given)
    assert {("cheats", "zero"), ("cheats", "left arm alone"), ("returns", "zero")} <= found(report)


def test_a_script_may_fail_where_a_cheat_has_led_it(reach):
    class Strict(reach.ReachBothScript):
        def script(self, fields):
            for wish in super().script(fields):
                fields = yield wish
                if np.abs(fields["commanded_q_rad"] - wish.q_rad).max() > 0.02:
                    raise UnreachableError("somebody else moves the arms")

    assert found(audited(type("Same", (reach.ReachBoth,), {}), Strict)) == set()


def test_an_episode_without_a_known_horizon(reach):
    class Endless(reach.ReachBoth):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            self.horizon = None

    assert found(audited(Endless)) == set()


def test_no_result_depends_on_the_number_of_rows(reach, monkeypatch):
    reports = []
    for rows in (2, 5):
        monkeypatch.setattr("dual_ur10.policies.evaluation.audit.audit._ROWS", rows)
        reports.append(audit(ID, quick=True))
    assert reports[0].returns == reports[1].returns
    assert reports[0].successes == reports[1].successes


def test_progress_is_shown(reach):
    shown = []
    audit(ID, quick=True, on_progress=shown.append)
    assert shown == sorted(shown)
    assert len(shown) > 100
    assert shown[-1] == 1.0


def test_there_is_no_script(registries):
    of_template(scripted="")
    report = audit(ID, quick=True)
    assert found(report) == {("script", "missing")}
    assert report.script_return is None
    assert "limit: one script" in str(report)


def test_there_is_no_reward():
    report = audit("Free", quick=True)
    assert [each.subject for each in report.findings] == ["reward"]


def test_further_cheats_are_tried_and_accepted_findings_are_notes(reach):
    script = load("scripted", ID)
    report = audit(ID, quick=True, cheats={"mine": script, "zeros": lambda observation: np.zeros(12, np.float32)})
    assert found(report) == {("cheats", "mine")}
    assert report.successes["mine"] == (1, 1)
    assert report.successes["zeros"] == (0, 1)

    class Accepting(reach.ReachBoth):
        accepted: ClassVar = {"mine": "it is the script"}

    report = audited(Accepting, cheats={"mine": script})
    assert found(report) == set()
    assert "note: cheats, mine: 1 of 1 episodes succeed (limit: 0). Accepted: it is the script" in str(report)


@pytest.mark.parametrize(
    ("keywords", "error", "match"),
    [
        ({"env_id": "Handoverr"}, UnknownNameError, "Handover"),
        ({"seed": -1}, SettingsError, "seed is -1: it must be a whole number, 0 or more"),
        ({"episodes": 0}, SettingsError, "episodes is 0"),
        ({"episodes": 1.5}, SettingsError, "episodes is 1.5"),
        ({"randomization": "mild"}, SettingsError, "randomization is set by the audit"),
        ({"action_mode": "joint_position"}, SettingsError, "use 'joint_delta'"),
        ({"cell": "echo"}, SettingsError, "the audit is for cell='mujoco'"),
        ({"amplitude": 1.0}, UnknownNameError, "amplitude"),
        ({"cheats": {"none": 3}}, PolicyError, "no policy"),
        ({"cheats": {"none": "absent:Policy"}}, SettingsError, "cannot be imported"),
    ],
)
def test_bad_arguments_are_refused_by_name(keywords, error, match):
    with pytest.raises(error, match=match):
        audit(**{"env_id": "SineTracking", "duration_s": 0.4, **keywords})


def test_the_command_writes_the_report_and_its_code(reach, tmp_path):
    code, text = run("audit", ID, "--quick", "--json", str(tmp_path / "audit.json"))
    assert code == 0
    assert "0 errors, 0 warnings" in text
    assert '"successes"' in (tmp_path / "audit.json").read_text()
    code, text = run("audit", ID, "--quick", "--cheat", f"{MODULE}:ReachBothScript")
    assert code == 1
    assert f"error: cheats, {MODULE}:ReachBothScript: 1 of 1 episodes succeed (limit: 0)" in text
