import logging
import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.errors import CellFaulted, PolicyError, SettingsError, UnknownNameError
from dual_ur10.testing import CellForTests, check_policy
from ur_core.processes.system import LOCAL

pytestmark = pytest.mark.streams

SINE = "DualUR10/SineTracking-v0"
SHORT = {"duration_s": 0.8}
DOCUMENT = Path(__file__).parents[1] / "docs" / "how-to" / "policy-in-ci.md"


class Good:
    """A policy of single observations and batches; each of the following classes breaks one rule."""

    def reset(self):
        self.step = 0

    def __call__(self, observation):
        self.step += 1
        action = np.zeros((*observation.shape[:-1], 12), dtype=np.float32)
        action[..., [0, 5]] = 0.02 * np.sin(self.step / 5)
        return action


class Single(Good):
    def __call__(self, observation):
        if observation.ndim != 1:
            raise ValueError("one at a time")
        return super().__call__(observation)


class Flat(Good):
    """Ignores the number of observations."""

    def __call__(self, observation):
        return super().__call__(observation.reshape(-1)[:80])


class Without(Good):
    reset = None


class ResetFails(Good):
    def reset(self):
        raise RuntimeError("no generator")


class Raises(Good):
    def __call__(self, observation):
        if self.step == 3:
            raise KeyError("weights")
        return super().__call__(observation)


class Changes(Good):
    def __call__(self, observation):
        observation /= 2.0
        return super().__call__(observation)


class Bends(Good):
    """Changes every action."""

    def bent(self, action):
        raise NotImplementedError

    def __call__(self, observation):
        return self.bent(super().__call__(observation))


class Nan(Bends):
    def bent(self, action):
        action[..., 8] = np.nan
        return action


class Outside(Bends):
    def bent(self, action):
        action[..., 1] = -1.5
        return action


class Shape(Bends):
    def bent(self, action):
        return action.reshape(2, 6)


class Text(Bends):
    def bent(self, action):
        return action.astype(str)


class Ragged(Bends):
    def bent(self, action):
        return [[0.0] * 6, [0.0] * 5]


class Nothing(Bends):
    def bent(self, action):
        return None


class Remembers(Good):
    """A reset that forgets nothing."""

    def __init__(self):
        self.step = 0

    def reset(self):
        """Nothing."""


class Chance(Bends):
    rng = np.random.default_rng(0)

    def bent(self, action):
        return action + np.float32(self.rng.uniform(-0.01, 0.01))


class Mixes(Good):
    """A row of a batch depends on the others."""

    def __call__(self, observation):
        action = super().__call__(observation)
        return action if observation.ndim == 1 else action + np.float32(0.1)


class Bows(Bends):
    """Moves down to the table until the gate refuses."""

    def bent(self, action):
        action[..., [1, 7]] = 1.0
        return action


ZOO = {
    "no reset": (Without(), "found no reset"),
    "a class": (Good, "a class, not an object"),
    "reset fails": (ResetFails(), "reset() raised RuntimeError: no generator"),
    "raises": (Raises(), "step 3: it raised KeyError: 'weights'"),
    "changes": (Changes(), "step 0: it changed the observation"),
    "nan": (Nan(), "step 0: number 8 of the action (right arm, 2) is nan: it must be finite"),
    "outside": (Outside(), "number 1 of the action (left arm, 1) is -1.5: allowed are -1 to 1"),
    "shape": (Shape(), "shape (2, 6), expected is (12,)"),
    "text": (Text(), "it must be numbers"),
    "ragged": (Ragged(), "no array of numbers"),
    "nothing": (Nothing(), "it must be numbers"),
    "remembers": (Remembers(), "step 0 after a reset: the action is other by"),
    "chance": (Chance(), "step 0 after a reset: the action is other by"),
    "mixes": (Mixes(), "a row of a batch of observations gets another action than alone, by up to 0.1"),
}


@pytest.mark.parametrize("name", ZOO)
def test_policies_that_break_a_rule_are_refused(name):
    policy, text = ZOO[name]
    with pytest.raises(PolicyError) as found:
        check_policy(policy, SINE, steps=12, **SHORT)
    assert text in str(found.value)


def test_a_policy_refused_by_the_gate_fails_the_check():
    with pytest.raises(PolicyError, match=r"step \d+: the safety gate refused it: .*distance"):
        check_policy(Bows(), SINE, at_limits="refuse")


@pytest.mark.parametrize(("policy", "batched"), [(Good(), True), (Single(), False), (Flat(), False)])
def test_the_report_of_a_good_policy(policy, batched):
    report = check_policy(policy, "SineTracking", **SHORT)
    assert report.env_id == SINE
    assert report.steps == 20
    assert report.batched is batched
    assert not report.success
    assert 0.0 < report.median_s <= report.worst_s
    assert report.budget_s == pytest.approx(0.016)
    assert report.cell_steps is None
    assert "20 steps, success no" in str(report)


def test_the_scripted_policy_passes_and_succeeds():
    report = check_policy(policies.load("scripted", SINE, duration_s=2.0), SINE, duration_s=2.0)
    assert report.success
    assert report.batched
    assert report.total_reward > 0.0


def test_steps_limit_the_episode():
    assert check_policy(Good(), SINE, steps=3).steps == 3


def test_observations_with_pixels():
    class Looks(Good):
        def __call__(self, observation):
            assert set(observation) == {"state", "pixels"}
            return super().__call__(observation["state"])

    keywords = {"observation": "both", "width": 32, "height": 32}
    assert check_policy(Looks(), SINE, steps=2, **keywords).batched

    class Paints(Looks):
        def __call__(self, observation):
            observation["pixels"]["front"][0, 0] = 255 - observation["pixels"]["front"][0, 0]
            return super().__call__(observation)

    with pytest.raises(PolicyError, match="it changed the observation"):
        check_policy(Paints(), SINE, steps=2, **keywords)


def test_a_slow_policy_is_a_note_and_no_error(monkeypatch, caplog):
    now = iter(np.arange(0.0, 1e4, 0.03))
    monkeypatch.setattr("dual_ur10.policies.evaluation.check.time.perf_counter", lambda: float(next(now)))
    with caplog.at_level(logging.WARNING):
        report = check_policy(Good(), SINE, steps=3)
    assert report.median_s == pytest.approx(0.03)
    assert "an action takes 30.0 ms, and on two controllers there are 16.0 ms" in report.notes[0]
    assert report.notes[0] in caplog.text
    assert check_policy(Good(), SINE, steps=3, action_latency_ticks=10).notes == ()


@pytest.mark.parametrize(
    ("keywords", "error"),
    [
        ({"steps": 0}, SettingsError),
        ({"steps": True}, SettingsError),
        ({"steps": 2.5}, SettingsError),
        ({"cell": 3}, SettingsError),
        ({"amplitude": 3}, UnknownNameError),
    ],
)
def test_illegal_settings_are_refused(keywords, error):
    with pytest.raises(error):
        check_policy(Good(), SINE, **keywords)


MORE = """
from pathlib import Path


@pytest.mark.parametrize("emulated_cell", [{"family": "e-series"}], indirect=True)
@pytest.mark.emulated_cell(family="cb3", powered=False)
def test_options(emulated_cell):
    assert emulated_cell.ask("state", arm="right", names=["robot_mode"]) == {"robot_mode": 3}
    assert 'family = "e-series"' in Path(emulated_cell.path).read_text()
    assert emulated_cell.left != emulated_cell.right
    assert emulated_cell.fault == ""
"""


@pytest.mark.emulated
@pytest.mark.real_time
def test_the_documented_example_runs_in_another_project(tmp_path, monkeypatch):
    conftest, tests = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    (tmp_path / "conftest.py").write_text(conftest)
    (tmp_path / "test_it.py").write_text(tests + MORE)
    home = tmp_path / "state"
    monkeypatch.setenv("XDG_STATE_HOME", str(home))
    (tmp_path / "pytest.ini").write_text("[pytest]\n")  # settings of no folder above
    command = [sys.executable, "-m", "pytest", "-q", "--strict-markers", "-p", "no:cacheprovider", "-W", "error"]
    for _ in range(3):
        found = subprocess.run([*command, str(tmp_path)], cwd=tmp_path, capture_output=True, text=True, timeout=240)
        if "this machine is too busy" not in found.stdout:
            break
    assert found.returncode == 0, found.stdout + found.stderr
    assert "5 passed" in found.stdout
    assert not list(home.rglob("fault-*")), "the fault of a cell that is gone was left behind"


WRONG = {
    '@pytest.mark.emulated_cell("Handover")': "name each option",
    '@pytest.mark.parametrize("emulated_cell", ["Handover"], indirect=True)': "must be a dict",
    '@pytest.mark.emulated_cell(cell="x.toml")': "leave out `cell`",
    "@pytest.mark.emulated_cell(colour=3)": "unknown options of emulated controllers: colour",
}


def test_illegal_options_are_refused(tmp_path):
    (tmp_path / "conftest.py").write_text('pytest_plugins = ["dual_ur10.testing"]\n')
    tests = [f"{mark}\ndef test_{row}(emulated_cell): pass\n" for row, mark in enumerate(WRONG)]
    (tmp_path / "test_it.py").write_text("import pytest\n" + "".join(tests))
    (tmp_path / "pytest.ini").write_text("[pytest]\n")  # settings of no folder above
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path)]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert "4 errors" in run.stdout, run.stdout
    for text in WRONG.values():
        assert text in run.stdout, run.stdout


def test_check_policy_needs_no_pytest():
    code = (
        "import sys; sys.modules['pytest'] = None\n"
        "import importlib.util as util; found = util.find_spec\n"
        "util.find_spec = lambda name, *rest: None if name == 'pytest' else found(name, *rest)\n"
        "import dual_ur10.testing as testing\n"
        "assert callable(testing.check_policy) and not hasattr(testing, 'emulated_cell')\n"
        "assert not {'torch', 'rtde_control'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_policy_that_fails_on_controllers_stops_both(tmp_path):
    class Later(Good):
        """Fails in the sixth step of an episode."""

        episodes, bad = 0, -1

        def reset(self):
            super().reset()
            self.episodes += 1

        def __call__(self, observation):
            action = super().__call__(observation)
            if self.episodes == self.bad and self.step == 6:
                action[3] = 2.0
            return action

    before = set(LOCAL.state_folder().glob("fault-*"))
    probe = Later()
    check_policy(probe, SINE, steps=10)
    policy = Later()
    policy.bad = probe.episodes + 1  # that on controllers
    with CellForTests(tmp_path, plant="nominal") as cell:
        with pytest.raises(PolicyError, match=r"step 5: number 3 of the action \(left arm, 3\) is 2"):
            check_policy(policy, SINE, cell=cell.path, steps=10)
        assert "the policy failed: step 5" in cell.fault
        with pytest.raises(CellFaulted, match="cell clear"):
            gym.make(SINE, cell=cell.path)
        cell.clear()
        assert cell.fault == ""
        for arm in ("left", "right"):
            cell.wait_until(arm, "runtime_state", 1)
    assert set(LOCAL.state_folder().glob("fault-*")) == before
