import re

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from dual_ur10 import errors, policies
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.perturbation import Perturbation

SINE = "DualUR10/SineTracking-v0"
WILD = CellConfig(perturbation=Perturbation(jitter_s=0.004, loss=0.05, latency_s=0.002, mass_scale=1.03))


def vector(n, **keywords):
    return gym.make_vec(SINE, num_envs=n, **keywords)


def random_actions(steps, n, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, n, 12)).astype(np.float32)


@pytest.mark.parametrize("cell", ["mujoco", WILD], ids=["nominal", "perturbed"])
@pytest.mark.parametrize(("n", "threads"), [(1, 1), (8, 1), (8, 2), (8, 5)])
def test_row_k_is_the_single_env_bit_for_bit(n, threads, cell):
    rows = [0] if n == 1 else [0, 3, 7]
    many = vector(n, threads=threads, cell=cell)
    observations, _ = many.reset(seed=20)
    actions = random_actions(40, n)
    singles = {row: gym.make(SINE, cell=cell) for row in rows}
    for row, env in singles.items():
        assert np.array_equal(env.reset(seed=20 + row)[0], observations[row])
    for action in actions:
        observations, rewards, terminated, truncated, info = many.step(action)
        for row, env in singles.items():
            observation, reward, end, over, single = env.step(action[row])
            assert np.array_equal(observation, observations[row])
            assert reward == rewards[row]
            assert (end, over) == (terminated[row], truncated[row])
            for name, value in single.items():
                assert np.array_equal(value, info[name][row])
                assert info["_" + name][row]
        if terminated.any():
            break


def test_spaces_and_types():
    env = vector(3)
    observation, info = env.reset(seed=0)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert env.observation_space.contains(observation)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert reward.shape == terminated.shape == truncated.shape == (3,)
    assert reward.dtype == np.float64
    assert terminated.dtype == truncated.dtype == bool
    assert info["q_rad"].shape == (3, 2, 6)


def lengths(env, steps):
    """Steps at which row 0 was truncated."""
    env.reset(seed=0)
    zero = np.zeros((env.num_envs, 12), dtype=np.float32)
    return [k for k in range(steps) if env.step(zero)[3][0]]


def test_autoreset_next_step():
    env = vector(2, duration_s=0.2)
    env.reset(seed=0)
    zero = np.zeros((2, 12), dtype=np.float32)
    results = [env.step(zero) for _ in range(11)]
    assert [bool(r[3][0]) for r in results] == [False] * 4 + [True] + [False] * 5 + [True]
    restarted = results[5]
    assert restarted[1].tolist() == [0.0, 0.0]
    assert "is_success" not in restarted[4]
    assert not np.array_equal(restarted[0], results[4][0])
    fresh = gym.make(SINE, duration_s=0.2)
    fresh.reset(seed=0)
    for _ in range(5):
        fresh.step(zero[0])
    assert np.array_equal(fresh.reset()[0], restarted[0][0])


def test_autoreset_same_step():
    env = vector(2, duration_s=0.2, autoreset_mode="SameStep")
    env.reset(seed=0)
    zero = np.zeros((2, 12), dtype=np.float32)
    results = [env.step(zero) for _ in range(5)]
    observation, _, _, truncated, info = results[-1]
    assert truncated.all()
    assert info["_final_obs"].all()
    assert not np.array_equal(info["final_obs"][0], observation[0])
    assert info["final_info"]["is_success"].shape == (2,)
    assert "is_success" not in info
    assert "final_obs" not in results[0][4]
    assert not env.step(zero)[3].any()


@pytest.mark.parametrize(("task", "name"), [("BoxLift", "height_m"), ("LidAndPlace", "lid_rad")])
def test_the_info_of_a_step_outlives_the_next_reset(task, name):
    same, none = (
        gym.make_vec(f"DualUR10/{task}-v0", num_envs=2, max_episode_steps=3, autoreset_mode=mode)
        for mode in ("SameStep", "Disabled")
    )
    for env in (same, none):
        env.reset(seed=0)
    zero = np.zeros(same.action_space.shape, dtype=np.float32)
    for _ in range(3):
        ended, last = same.step(zero)[4], none.step(zero)[4]
    before = last[name].copy()
    assert before.all()  # 0 is the value of a begin
    assert np.array_equal(ended["final_info"][name], before)
    none.reset()
    assert np.array_equal(last[name], before)


def test_autoreset_disabled_needs_a_reset_by_mask():
    env = vector(3, duration_s=0.2, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0)
    zero = np.zeros((3, 12), dtype=np.float32)
    for _ in range(5):
        observation, _, _, truncated, _ = env.step(zero)
    assert truncated.all()
    with pytest.raises(errors.SettingsError, match="reset_mask"):
        env.step(zero)
    mask = np.array([True, False, True])
    after, info = env.reset(options={"reset_mask": mask})
    assert np.array_equal(info["_q_rad"], mask)
    assert np.array_equal(after[1], observation[1])
    assert not np.array_equal(after[0], observation[0])
    with pytest.raises(errors.SettingsError, match=r"\[1\]"):
        env.step(zero)
    env.reset(options={"reset_mask": ~mask})
    assert not env.step(zero)[3].any()


def test_modes_agree_on_the_episodes():
    for mode, ends in (("NextStep", [4, 10]), ("SameStep", [4, 9])):
        assert lengths(vector(2, duration_s=0.2, autoreset_mode=mode), 12)[:2] == ends


def test_max_episode_steps_is_enforced():
    assert lengths(vector(2, max_episode_steps=3), 9) == [2, 6]


def test_a_reset_row_does_not_touch_the_others():
    env, control = vector(3), vector(3)
    env.reset(seed=0)
    control.reset(seed=0)
    actions = random_actions(20, 3)
    for action in actions[:10]:
        env.step(action)
        control.step(action)
    env.reset(seed=[None, 77, None], options={"reset_mask": np.array([False, True, False])})
    for action in actions[10:]:
        ours, theirs = env.step(action)[0], control.step(action)[0]
        assert np.array_equal(ours[[0, 2]], theirs[[0, 2]])
        assert not np.array_equal(ours[1], theirs[1])


def test_a_refused_row_has_its_reason_and_restarts():
    env = vector(2, action_mode="joint_position", randomize=False, on_refusal="terminate", at_limits="refuse")
    _, info = env.reset(seed=0)
    goal = info["q_rad"].copy()
    goal[1, :, 1] += 1.2  # row 1 drives into the table
    for _ in range(60):
        _, _, terminated, _, info = env.step(goal.reshape(2, 12).astype(np.float32))
        if terminated.any():
            break
    assert terminated.tolist() == [False, True]
    assert info["_safety"].tolist() == [False, True]
    assert info["safety"][1].kind == "distance"
    assert info["end_reason"].tolist() == [None, "refused/distance"]
    assert info["_end_reason"].tolist() == [False, True]
    _, reward, terminated, _, info = env.step(goal.reshape(2, 12).astype(np.float32))
    assert not terminated.any()
    assert reward[1] == 0.0
    assert "safety" not in info


def test_rows_are_called_as_gymnasium_calls_its_own():
    own, sync = vector(3), gym.make_vec(SINE, num_envs=3, vectorization_mode="sync")
    for env in (own, sync):
        env.reset(seed=7)
    for name in ("observation_space", "action_space", "render_mode"):
        assert own.get_attr(name) == own.call(name) == sync.get_attr(name)
    assert [each["render_fps"] for each in own.get_attr("metadata")] == [25] * 3
    assert [each.settings for each in own.get_attr("task")] == [each.settings for each in sync.get_attr("task")]
    assert own.call("__format__", "") == (str(own),) * 3
    rngs = zip(own.get_attr("np_random"), sync.get_attr("np_random"), strict=True)
    assert all(ours.bit_generator.state == theirs.bit_generator.state for ours, theirs in rngs)
    for env in (own, sync):
        env.set_attr("note", "all")
        assert env.get_attr("note") == ("all",) * 3
        env.set_attr("note", ["each"] * 3)
        assert env.get_attr("note") == ("each",) * 3
        with pytest.raises(ValueError, match="3"):
            env.set_attr("note", [1, 2])
        with pytest.raises(AttributeError, match="colour"):
            env.get_attr("colour")
    with pytest.raises(errors.SettingsError, match="share one core"):
        own.set_attr("note", [1, 2, 3])
    with pytest.raises(errors.SettingsError, match="reset"):
        own.call("reset")


def test_a_diverged_row_ends_alone():
    env, control = vector(3), vector(3)
    for each in (env, control):
        each.reset(seed=0)
        each.step(np.zeros((3, 12), dtype=np.float32))
    env.core.cell._physics._arms_qd[1, 0, 2] = np.nan
    observation, _, terminated, _, info = env.step(np.zeros((3, 12), dtype=np.float32))
    expected = control.step(np.zeros((3, 12), dtype=np.float32))[0]
    assert terminated.tolist() == [False, True, False]
    assert "diverged" in info["physics_error"][1]
    assert np.isfinite(observation).all()
    assert np.array_equal(observation[[0, 2]], expected[[0, 2]])
    observation, _, terminated, _, info = env.step(np.zeros((3, 12), dtype=np.float32))
    assert not terminated.any()
    assert "physics_error" not in info


def test_scripted_policy_on_a_batch():
    env = vector(6, duration_s=6.0)
    policy = policies.load("scripted", SINE)
    observation, _ = env.reset(seed=0)
    over = np.zeros(6, dtype=bool)
    while not over.any():
        observation, _, terminated, over, info = env.step(policy(observation))
        assert not terminated.any()
    assert over.all()
    assert info["is_success"].all()
    assert info["flange_error_m"].max() < 1e-5


@pytest.mark.parametrize(
    ("keywords", "error", "text"),
    [
        ({"num_envs": 0}, errors.SettingsError, "num_envs"),
        ({"num_envs": 10**12}, errors.SettingsError, "num_envs is 1000000000000, too many for the memory: "),
        ({"record": "a\0b"}, errors.SettingsError, "record is 'a\\x00b': it must be the path of a folder"),
        ({"autoreset_mode": "Never"}, errors.UnknownNameError, "NextStep"),
        ({"max_episode_steps": 0}, errors.SettingsError, "max_episode_steps"),
        ({"render_mode": "human"}, errors.UnknownNameError, "rgb_array"),
        ({"amplitudes": 1}, errors.UnknownNameError, "amplitude_m"),
    ],
)
def test_bad_keywords(keywords, error, text):
    with pytest.raises(error, match=re.escape(text)):
        gym.make_vec(SINE, **{"num_envs": 2, **keywords})


def test_bad_resets_and_actions():
    env = vector(2)
    with pytest.raises(errors.SettingsError, match="3 seeds"):
        env.reset(seed=[1, 2, 3])
    env.reset(seed=0)
    with pytest.raises(errors.SettingsError, match="reset_mask"):
        env.reset(options={"reset_mask": np.array([1, 0])})
    with pytest.raises(errors.UnknownNameError, match="reset_mask"):
        env.reset(options={"mask": None})
    with pytest.raises(errors.ActionError, match="shape"):
        env.step(np.zeros(12))
    with pytest.raises(errors.ActionError, match="cell 1"):
        env.step(np.array([np.zeros(12), np.full(12, np.nan)]))
    env.close()
    with pytest.raises(errors.ClosedError):
        env.core.step(np.zeros((2, 12)))


def test_rendering_gives_an_image_per_cell():
    env = vector(2, render_mode="rgb_array", width=64, height=48)
    env.reset(seed=0)
    images = env.render()
    assert [image.shape for image in images] == [(48, 64, 3)] * 2
    assert not np.array_equal(*images)
    assert vector(2).render() is None


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_scripted_policy_notices_new_episodes_of_its_rows(mode):
    env = vector(
        3, autoreset_mode=mode, max_episode_steps=60, cell=CellConfig(perturbation=Perturbation(mass_scale=1.05))
    )
    policy = policies.load("scripted", SINE)
    observation, _ = env.reset(seed=0)
    worst = []
    for k in range(200):
        if k == 30:  # one row alone
            observation, _ = env.reset(options={"reset_mask": np.array([False, True, False])})
        observation, _, terminated, _, info = env.step(policy(observation))
        assert not terminated.any()
        if "flange_error_m" in info:  # not of rows that only reset
            worst.append(info["flange_error_m"][info["_flange_error_m"]].max())
    assert max(worst) < 1e-3  # 14 mm where a row remembers another episode


def test_the_first_reset_is_of_all_rows():
    env = vector(2)
    with pytest.raises(errors.ResetNeededError, match="all rows"):
        env.reset(seed=0, options={"reset_mask": np.array([True, False])})


def test_the_action_of_a_restarting_row_is_ignored():
    env = vector(2, duration_s=0.2)
    env.reset(seed=0)
    zero = np.zeros((2, 12), dtype=np.float32)
    for _ in range(5):
        env.step(zero)
    assert not env.step(np.full((2, 12), np.nan, dtype=np.float32))[2].any()


def test_a_failed_reset_must_be_repeated():
    env = vector(2)
    env.reset(seed=0)
    good = env.core.task.start
    env.core.task.start = lambda rows, rngs: good(rows, rngs)._replace(q_rad=good(rows, rngs).q_rad + 1.0)
    with pytest.raises(errors.CollisionAtStartError, match="apart"):
        env.reset()
    env.core.task.start = good
    with pytest.raises(errors.ResetNeededError):
        env.step(np.zeros((2, 12), dtype=np.float32))
    env.reset()
    env.step(np.zeros((2, 12), dtype=np.float32))


def test_seed_may_be_a_numpy_number():
    one, other = vector(2), vector(2)
    assert np.array_equal(one.reset(seed=np.int64(3))[0], other.reset(seed=3)[0])
