"""Virtual cell: episodes that are equal to the bit, and requests that only real processes can serve."""

import copy
import functools
import pickle
import signal
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.emulated.cell_emulator import CellEmulator
from dual_ur10.errors import CellFaulted, SettingsError, UnknownNameError, VirtualCellError
from dual_ur10.policies import load
from dual_ur10.testing import VirtualCell, check_policy
from tests import rollout_hashes
from tests.cli.command import run
from ur_core.processes.system import System


@functools.cache
def shared_episode():
    """Return the episode of a nominal cell."""
    return episode()


def episode(steps=18, fault=None, observation="state", **options):
    """Return what both controllers received, observations, and the error that ended it, if one did."""
    seen, error = [], None
    with VirtualCell(task="SineTracking", plant="nominal", **options) as cell:
        env = gym.make("DualUR10/SineTracking-v0", cell=cell, disable_env_checker=True, observation=observation)
        seen.append(env.reset(seed=0)[0])
        try:
            for step in range(steps):
                if step == 10 and fault:
                    cell.ask(**fault)
                action = np.full(env.action_space.shape, 0.2 * np.sin(step / 5), dtype=np.float32)
                seen.append(env.step(action)[0])
        except CellFaulted as found:
            error = str(found)
        env.close()
        received = [cell.packages(arm) for arm in ("left", "right")]
        return received, np.array(seen).tobytes(), error, cell.fault, cell.now_s


def test_an_episode_is_the_same_to_the_bit():
    first = shared_episode()
    assert len(first[0][0]) > 60
    assert first[2] is None
    assert not first[3]
    assert episode() == first


def test_the_concise_view_is_that_of_what_is_measured():
    received, state, *_ = episode(5)
    same, shown, *_ = episode(5, observation="goals")
    assert same == received
    view = gym.make("DualUR10/SineTracking-v0", cell="echo").unwrapped.task.concise_view()
    expected = view(np.frombuffer(state).reshape(6, -1))
    assert np.array_equal(np.frombuffer(shown, dtype=np.float32).reshape(6, -1), expected)


def test_handover_hash():
    rollout_hashes.check("virtual handover", hashed_handover)


def hashed_handover():
    """Hash a handover on both controllers by random actions: what is seen, what they receive, and the clock."""
    rng, seen = np.random.default_rng(7), []
    with VirtualCell(task="Handover", plant="mild", seed=3) as cell:
        env = cell.make("DualUR10/Handover-v0")
        seen.append(env.reset(seed=11)[0])
        for _ in range(40):
            observation, *rest, _ = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
            seen += [observation, rest]
        env.close()
        received = [cell.packages(arm) for arm in ("left", "right")]
        seen += [[tick, kind, *numbers] for each in received for tick, kind, numbers in each] + [cell.now_s]
    return rollout_hashes.digest(*seen)


def test_a_stop_is_the_same_to_the_bit():
    first = episode(fault={"do": "stop", "arm": "left", "mode": 3})
    assert "PROTECTIVE_STOP" in first[2]
    assert "left" in first[3]
    assert episode(fault={"do": "stop", "arm": "left", "mode": 3}) == first


def test_other_phases_of_the_controllers_give_other_bits():
    assert episode(drift_ppm=100.0)[0] != shared_episode()[0]


@pytest.mark.parametrize(("phase_s", "drift_ppm"), [(0.003, 0.0), (0.005, -200.0)])
def test_two_controllers_with_clocks_of_their_own_follow_one_path(phase_s, drift_ppm):
    right = {"phase_s": phase_s, "drift_ppm": drift_ppm}
    received, _, error, fault, _ = episode(right=right, phase_s=0.0, drift_ppm=100.0)
    assert error is None
    assert not fault
    targets = [np.array([numbers for _, _, numbers in packages]) for packages in received]
    left, right_arm = (np.abs(each - each[0]).max(axis=0) for each in targets)
    assert left.min() > 0.01
    np.testing.assert_allclose(right_arm, left, atol=1e-4)
    if drift_ppm:
        assert episode(right=right, phase_s=0.0, drift_ppm=100.0)[0] == received


def test_two_controllers_hold_no_object():
    with pytest.raises(VirtualCellError, match="one object"):
        VirtualCell(task="SyncCarry", right={})


@pytest.mark.parametrize("name", ["view", "cell"])
def test_a_virtual_cell_refuses_what_only_processes_show(name):
    with pytest.raises(VirtualCellError, match=name):
        VirtualCell(**{name: True})


def test_a_real_time_priority_is_refused():
    with VirtualCell(task="SineTracking", file={"rt_priority": 5}) as cell:
        with pytest.raises(Exception, match="scheduling priorities"):
            gym.make("DualUR10/SineTracking-v0", cell=cell, disable_env_checker=True)
        cell.clear()


def test_a_missing_extra_is_named():
    code = """import sys
sys.modules["rtde_control"] = None
from dual_ur10.testing import VirtualCell
VirtualCell()"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert found.returncode == 1
    assert 'pip install "ur-emulator[virtual]"' in found.stderr


def test_ctrl_c_while_a_controller_computes_ends_a_rollout_without_an_alarm(monkeypatch):
    tick = CellEmulator.tick

    def interrupted(self):
        if self.ticks == 400:  # both arms move
            signal.raise_signal(signal.SIGINT)
        tick(self)

    monkeypatch.setattr(CellEmulator, "tick", interrupted)
    code, text = run("rollout", "SineTracking", "--cell", "virtual", "-n", "1", "--no-record")
    assert (code, text) == (130, "interrupted: both arms have stopped\n")


def test_it_is_one_thing_with_a_system_of_its_own():
    """It names what cannot be done, is copied as itself, leaves nothing to this machine, and closes twice."""
    with VirtualCell() as cell:
        with pytest.raises(UnknownNameError, match="emulated cell"):
            cell.stall("the left one", 1.0)
        with pytest.raises(VirtualCellError, match="sleep"):
            cell.end("program")
        assert copy.deepcopy(cell) is cell
        with pytest.raises(SettingsError, match="pickled"):
            pickle.dumps(cell)
        assert isinstance(cell.system, System)
        public = {name for name in vars(System) if not name.startswith("_")}
        assert len(public) > 20
        assert not public - set(vars(type(cell.system)))
    cell.close()


def test_controllers_that_end_close_their_connections():
    with VirtualCell() as cell:
        client = cell.system.connect(cell.left, 30004, 1.0)
        cell.ask("shutdown")
        cell.clock.sleep(0.1)
        assert client.receive_now(1) == b""
        with pytest.raises(ConnectionRefusedError):
            cell.system.connect(cell.left, 30004, 1.0)


def test_a_policy_is_checked_on_it():
    env_id = "DualUR10/SineTracking-v0"
    with VirtualCell() as cell:
        policy = load("scripted", env_id, cell=cell, duration_s=1.0)
        report = check_policy(policy, env_id, cell=cell, duration_s=1.0)
    assert report.cell_success
    assert report.cell_steps == report.steps == 25
    assert report.late == 0
