"""Refusals on a cell of two controllers, behind every interface; none of them needs a controller."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10 import Perturbation
from dual_ur10.envs import dm_env
from dual_ur10.envs.api.dual_arm_env import DualArmEnv
from dual_ur10.envs.api.parallel_env import parallel_env
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.core.options import MOVE_TO_START
from dual_ur10.envs.core.randomization import Randomization
from dual_ur10.envs.core.sensing import Sensing
from dual_ur10.envs.core.setup import EnvSetup, check_for_controllers
from dual_ur10.errors import ResetNeededError, ResetRefusedError, SettingsError, StartError
from dual_ur10.policies.baselines import ZeroPolicy
from dual_ur10.policies.evaluation import evaluate as evaluation
from dual_ur10.policies.evaluation.rollout import rollout
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.cell_file.reference import starting_text
from dual_ur10.sim2real.runtime.rtde_cell import RtdeCell
from ur_core.mjcf.gains import COMPLIANT

SINE, HANDOVER = "DualUR10/SineTracking-v0", "DualUR10/Handover-v0"
BY_THEMSELVES = "episodes that begin by themselves, as in training, on a cell of controllers"
REFUSED = r"nothing may do that by itself.*reset\(options=\{\"move_to_start\": True\}\)"
CONSENT = {MOVE_TO_START: True}


@pytest.fixture(params=["real", "emulated"])
def path(request, tmp_path, monkeypatch):
    """Cell file of controllers that must not be reached."""

    def reached(*_, **__):
        pytest.fail("the controllers were reached")

    monkeypatch.setattr(RtdeCell, "__init__", reached)
    hosts = ("192.0.2.1", "192.0.2.2") if request.param == "real" else ("127.0.0.2", "127.0.0.3")
    file = tmp_path / "lab.toml"
    file.write_text(starting_text(request.param, *hosts))
    return str(file)


def take_for_controllers(core, path):
    """Let a simulated environment take its cell for that of a cell file."""
    core.setup = replace(core.setup, config=load_cell_file(path).config())


@pytest.fixture
def arms(path, monkeypatch):
    """A simulated environment that takes its cell for one of controllers, and counts how often it moves to a start."""
    env = DualArmEnv("SineTracking", duration_s=0.2)
    take_for_controllers(env.core, path)
    env.moves, reset = 0, env.core.cell.reset

    def counted(*args, **keywords):
        env.moves += 1
        return reset(*args, **keywords)

    monkeypatch.setattr(env.core.cell, "reset", counted)
    yield env
    env.close()


def run(env, action, steps=10):
    """Step beyond the end of an episode."""
    for _ in range(steps):
        env.step(action)


def test_our_vector_environment_with_autoreset_is_refused_before_it_connects(path):
    with pytest.raises(SettingsError, match=BY_THEMSELVES):
        gym.make_vec(HANDOVER, num_envs=1, vectorization_mode="vector_entry_point", cell=path)


@pytest.mark.parametrize(
    "wrapper",
    [
        lambda env: gym.vector.SyncVectorEnv([lambda: env]),
        lambda env: gym.vector.SyncVectorEnv([lambda: env], autoreset_mode="SameStep"),
        gym.wrappers.Autoreset,
        lambda env: gym.wrappers.Autoreset(gym.wrappers.RecordEpisodeStatistics(env)),
    ],
    ids=["next step", "same step", "Autoreset", "wrapped"],
)
def test_a_wrapper_that_resets_by_itself_does_not_move_the_arms(arms, wrapper):
    env = wrapper(arms)
    env.reset(seed=0)
    with pytest.raises(ResetRefusedError, match=REFUSED):
        run(env, env.action_space.sample())
    assert arms.moves == 1


def test_stable_baselines3_does_not_move_the_arms_by_itself(path, arms):
    pytest.importorskip("stable_baselines3", reason="needs the extra train")
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv

    from dual_ur10.envs.api.sb3_bridge import JointVecEnv, TwoAgentVecEnv

    for kind in (JointVecEnv, TwoAgentVecEnv):
        with pytest.raises(SettingsError, match=BY_THEMSELVES):
            kind("SineTracking", 1, cell=path)
        with pytest.raises(SettingsError, match="2 environments on one cell"):
            kind("SineTracking", 2, cell=path)
    env = DummyVecEnv([lambda: Monitor(arms)])
    env.set_options(CONSENT)  # consents to the first reset alone: Stable-Baselines3 forgets options once they are used
    env.reset()
    with pytest.raises(ResetRefusedError, match=REFUSED):
        run(env, [env.action_space.sample()])
    assert arms.moves == 1


def test_a_program_resets_as_often_as_it_consents(arms):
    env = gym.wrappers.TimeLimit(gym.wrappers.RecordEpisodeStatistics(arms), 3)
    for episode in range(3):
        env.reset(seed=0, options=CONSENT if episode else None)
        while not any(env.step(env.action_space.sample())[2:4]):
            pass
    for refused in (None, {}, {MOVE_TO_START: False}):
        with pytest.raises(ResetRefusedError, match=REFUSED):
            env.reset(seed=0, options=refused)
    with pytest.raises(SettingsError, match="move_to_start is 1: it must be True or False"):
        env.reset(options={MOVE_TO_START: 1})
    assert arms.moves == 3


def test_a_failed_first_reset_may_be_repeated(arms, monkeypatch):
    reset = arms.core.cell.reset

    def failing(*_, **__):
        raise StartError("nobody confirmed")

    monkeypatch.setattr(arms.core.cell, "reset", failing)
    with pytest.raises(StartError):
        arms.reset(seed=0)
    monkeypatch.setattr(arms.core.cell, "reset", reset)
    arms.reset(seed=0)


def test_a_refused_reset_changes_nothing(arms):
    arms.reset(seed=0)
    action = np.zeros(12, dtype=np.float32)
    arms.step(action)
    with pytest.raises(ResetRefusedError):
        arms.reset()
    assert arms.moves == 1
    assert arms.step(action)[4]["q_rad"].shape == (2, 6)  # the episode goes on


def test_confirm_consents_to_every_reset(arms):
    core = arms.core
    core.setup = replace(core.setup, options=replace(core.setup.options, confirm=lambda question: True))
    for _ in range(2):
        arms.reset(seed=0)
    assert arms.moves == 2


def test_a_vector_environment_without_autoreset_passes_the_consent_on(arms):
    env = gym.vector.SyncVectorEnv([lambda: arms], autoreset_mode="Disabled")
    env.reset(seed=0)
    with pytest.raises(ResetRefusedError):
        env.reset(seed=0)
    env.reset(seed=0, options=CONSENT)
    assert arms.moves == 2


def test_our_vector_environment_needs_consent(path):
    env = gym.make_vec(SINE, num_envs=1, vectorization_mode="vector_entry_point", autoreset_mode="Disabled")
    take_for_controllers(env.unwrapped.core, path)
    env.reset(seed=0)
    with pytest.raises(ResetRefusedError):
        env.reset(options={"reset_mask": np.array([True])})
    env.reset(options={"reset_mask": np.array([True]), **CONSENT})
    env.close()


@pytest.mark.parametrize("consent", [{}, {"move_to_start": False}, {"move_to_start": True}, {"confirm": True}])
def test_an_evaluation_takes_its_consent_from_its_caller(path, monkeypatch, consent):
    moves = []
    make = evaluation._make

    def made(*arguments):
        env = make(*arguments)
        take_for_controllers(env.unwrapped.core, path)
        core = env.unwrapped.core
        if "confirm" in consent:
            core.setup = replace(core.setup, options=replace(core.setup.options, confirm=lambda question: True))
        reset = core.cell.reset
        monkeypatch.setattr(
            core.cell, "reset", lambda *args, **keywords: (moves.append(1), reset(*args, **keywords))[1]
        )
        return env

    monkeypatch.setattr(evaluation, "_make", made)
    keywords = {name: value for name, value in consent.items() if name == "move_to_start"}

    def evaluate(episodes):
        return evaluation.evaluate(
            SINE, "zero", episodes=episodes, num_envs=1, env_kwargs={"duration_s": 0.2}, **keywords
        )

    if any(consent.values()):
        assert len(evaluate(2).episodes) == len(moves) == 2
        return
    with pytest.raises(ResetRefusedError, match=r"needs your consent: pass evaluate\(\.\.\., move_to_start=True\)"):
        evaluate(2)
    assert moves == []
    assert len(evaluate(1).episodes) == len(moves) == 1


def test_two_agents_need_consent(path):
    env = parallel_env("SineTracking", duration_s=0.2)
    take_for_controllers(env.unwrapped._env.core, path)
    env.reset(seed=0)
    with pytest.raises(ResetRefusedError):
        env.reset()
    env.reset(options=CONSENT)
    env.close()


def test_rollouts_consent(arms):
    for seed in range(2):
        rollout(arms, ZeroPolicy(arms.action_space), seed=seed)
    assert arms.moves == 2


def test_dm_env_does_not_begin_an_episode_in_a_step(path):
    env = dm_env(SINE, duration_s=0.2)
    take_for_controllers(env.env.core, path)
    action = np.zeros(12, dtype=np.float32)
    with pytest.raises(ResetNeededError, match=r"call reset\(\) first"):
        env.step(action)
    for _ in range(2):
        step = env.reset(move_to_start=True)
        while not step.last():
            step = env.step(action)
        with pytest.raises(ResetNeededError, match=r"on a cell of controllers none begins by itself"):
            env.step(action)
        with pytest.raises(ResetRefusedError, match=REFUSED):
            env.reset()
    env.close()


def test_two_agents_are_not_refused(path):
    with pytest.raises(pytest.fail.Exception, match="the controllers were reached"):
        parallel_env("SineTracking", cell=path)


def test_nothing_is_added_to_what_controllers_measure(path):
    config = load_cell_file(path).config()
    core = DualArmEnv("Handover").core
    config = config.equipped(core.config.equipment, 0.001, COMPLIANT)
    assert config.equipment.grippers
    assert Sensing(config, Randomization(), 0.04, 1).is_exact
    assert not Sensing(core.config, Randomization(), 0.04, 1).is_exact
    core.close()


def test_a_brake_after_a_refusal_is_refused(path):
    with pytest.raises(SettingsError, match="both arms stop, and a person decides"):
        Core("SineTracking", {"cell": path, "on_refusal": "brake"})
    assert not EnvSetup.resolve("SineTracking", {"cell": path}).brakes


def test_randomization_and_perturbation_are_refused(path):
    config = load_cell_file(path).config()
    check_for_controllers(config, 1, autoreset=False, randomized=False)
    with pytest.raises(SettingsError, match="randomization is for simulated cells"):
        check_for_controllers(config, 1, autoreset=False, randomized=True)
    shifted = replace(config, perturbation=Perturbation(base_shift_m=0.01))
    with pytest.raises(SettingsError, match="a perturbation is for simulated cells"):
        check_for_controllers(shifted, 1, autoreset=False, randomized=False)
