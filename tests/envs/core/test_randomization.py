import dataclasses

import gymnasium as gym
import numpy as np
import pytest

import dual_ur10
from dual_ur10 import errors
from dual_ur10.envs.core.randomization import PRESETS, Randomization, apply_sample, resolve_randomization

CARRY, SINE = "DualUR10/SyncCarry-v0", "DualUR10/SineTracking-v0"


def sample(randomization, seed=0, n=1):
    return randomization.sample([np.random.default_rng(seed + k) for k in range(n)])


@pytest.mark.parametrize("env_id", dual_ur10.ENV_IDS)
def test_rows_of_a_vector_env_are_single_envs_under_randomization(env_id):
    keywords = {"randomization": "wide"}
    many = gym.make_vec(env_id, num_envs=3, autoreset_mode="Disabled", **keywords)
    together, begun = many.reset(seed=5)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.05, 0.05, (8, *many.action_space.shape)).astype(np.float32)
    trace, flags = [together], []
    for action in actions[:4]:
        observation, reward, *_ = many.step(action)
        trace.append(observation)
        flags.append(reward)
    # One row begins anew in between: the others go on as if nothing had happened.
    fresh, again = many.reset(seed=[None, 40, None], options={"reset_mask": np.array([False, True, False])})
    assert np.array_equal(fresh[[0, 2]], trace[-1][[0, 2]])
    assert again["_randomization"].tolist() == [False, True, False]
    for action in actions[4:]:
        trace.append(many.step(action)[0])
    for row, seed in ((0, 5), (2, 7)):
        alone = gym.make(env_id, **keywords)
        observation, info = alone.reset(seed=seed)
        assert np.array_equal(observation, trace[0][row])
        for name, value in info["randomization"].items():
            assert np.array_equal(value, begun["randomization"][name][row]), name
        for k, action in enumerate(actions):
            observation, reward, *_ = alone.step(action[row])
            assert np.array_equal(observation, trace[k + 1][row])
            if k < 4:
                assert reward == flags[k][row]
    alone = gym.make(env_id, **keywords)
    observation, _ = alone.reset(seed=40)
    assert np.array_equal(observation, fresh[1])
    for k, action in enumerate(actions[4:]):
        assert np.array_equal(alone.step(action[1])[0], trace[k + 5][1])


def test_none_samples_and_changes_nothing():
    plain, none = gym.make(SINE), gym.make(SINE, randomization="none")
    first, info = plain.reset(seed=1)
    assert np.array_equal(first, none.reset(seed=1)[0])
    assert "randomization" not in info
    rng = np.random.default_rng(3)
    expected = np.random.default_rng(3)
    assert PRESETS["none"].is_none
    assert not PRESETS["mild"].is_none
    assert rng.random() == expected.random()


@pytest.mark.parametrize("preset", ["mild", "wide"])
def test_samples_fill_their_ranges(preset):
    wanted = PRESETS[preset]
    values = sample(wanted, n=400)
    for name, half, middle in (
        ("mass_scale", wanted.mass, 1.0),
        ("lookahead_scale", wanted.lookahead, 1.0),
        ("base_shift_m", wanted.base_shift_m, 0.0),
        ("base_turn_rad", wanted.base_turn_rad, 0.0),
        ("object_mass_scale", wanted.object_mass, 1.0),
        ("grip_friction_scale", wanted.grip_friction, 1.0),
    ):
        away = np.abs(values[name] - middle)
        assert 0.9 * half < away.max() <= half + 1e-12, name
        assert abs(np.mean(values[name] - middle)) < 0.2 * half, name
    assert values["friction_nm"].min() >= 0.0
    assert values["friction_nm"].max(axis=(0, 1)) == pytest.approx(
        np.array([5, 5, 3, 1, 1, 1]) * wanted.joint_friction, rel=0.05
    )
    late = values["latency_s"]
    assert 0.0 <= late.min() < late.max() <= wanted.latency_s + wanted.skew_s
    assert np.abs(late[:, 0] - late[:, 1]).max() <= wanted.skew_s
    assert values["object_offset_m"].std() == pytest.approx(wanted.object_noise_m, rel=0.1)
    assert values["object_offset_rad"].std() == pytest.approx(wanted.object_noise_rad, rel=0.1)
    assert values["observation_delay_s"].max() <= wanted.observation_delay_s


@pytest.mark.parametrize("name", [each.name for each in dataclasses.fields(Randomization)])
def test_every_value_has_an_effect_alone(name):
    value = 3.0 if name == "object_spread" else 0.02
    keywords = {"randomization": {name: value}}
    changed, plain = gym.make(CARRY, **keywords), gym.make(CARRY)
    (first, info), (other, _) = changed.reset(seed=2), plain.reset(seed=2)
    differs = not np.array_equal(first, other)
    action = np.full(14, 0.2, dtype=np.float32)
    for k in range(30):
        action[[6, 13]] = 1.0 if k < 15 else -1.0
        one, other = changed.step(action), plain.step(action)
        differs |= not np.array_equal(one[0], other[0])
        if one[2] or other[2] or differs:
            break
    if name in ("object_mass", "grip_friction"):  # nothing was touched
        assert info["randomization"][f"{name}_scale"].ravel()[0] != 1.0
    else:
        assert differs


def test_presets_can_be_changed_value_by_value():
    changed = resolve_randomization({"preset": "mild", "mass": 0.2})
    assert changed == dataclasses.replace(PRESETS["mild"], mass=0.2)
    assert resolve_randomization(changed) is changed
    with pytest.raises(errors.UnknownNameError, match="mild"):
        resolve_randomization("strong")
    with pytest.raises(errors.UnknownNameError, match="mass"):
        resolve_randomization({"masses": 0.1})
    with pytest.raises(errors.UnknownNameError):
        resolve_randomization(3)
    with pytest.raises(errors.SettingsError, match="latency_s"):
        Randomization(latency_s=-0.1)
    with pytest.raises(errors.SettingsError, match="mass"):
        Randomization(mass=True)


def test_samples_apply_on_top_of_the_cells_perturbation():
    plant = {"mass_scale": np.full((2, 2), 1.1), "latency_s": np.full((2, 2), 0.002), "loss": np.zeros((2, 2))}
    drawn = {"mass_scale": np.full((2, 2), 0.9), "latency_s": np.full((2, 2), 0.003), "observation_delay_s": np.ones(2)}
    result = apply_sample(plant, drawn)
    assert set(result) == {"mass_scale", "latency_s"}
    assert np.allclose(result["mass_scale"], 0.99)
    assert np.allclose(result["latency_s"], 0.005)


def test_a_range_of_the_user_overrides_the_preset():
    wide = PRESETS["wide"]
    made = gym.make(CARRY, randomization="wide").unwrapped.task.settings
    assert made.object_range_m == pytest.approx(0.02 * wide.object_spread)
    made = gym.make(CARRY, randomization="wide", object_range_m=0.01).unwrapped.task.settings
    assert made.object_range_m == 0.01
    assert made.object_turn_rad == pytest.approx(0.05 * wide.object_spread)


def test_the_plant_differs():
    env = gym.make(CARRY, randomization="wide")
    core = env.unwrapped.core
    for seed in (3, 4):
        _, info = env.reset(seed=seed)
        drawn, batch = info["randomization"], core.cell._physics._batch
        model = batch.model
        link, bar = model.body("left/upper_arm_link").id, model.body("bar/bar").id
        assert np.allclose(batch.expand("body_mass")[0, link], 12.7 * drawn["mass_scale"][0])
        assert np.allclose(batch.expand("body_mass")[0, bar], 4.0 * drawn["object_mass_scale"])
        pad = model.geom("right/pad_1").id
        assert np.allclose(batch.expand("geom_friction")[0, pad, 0], drawn["grip_friction_scale"][1])
        assert np.allclose(batch.expand("dof_frictionloss")[0, 8:14], drawn["friction_nm"][1])
        assert np.array_equal(core.cell._delay.latency[0], np.rint(drawn["latency_s"] / 0.001))
        # A base that stands elsewhere carries its flange along, while the arm reports what it believes.
        state = core._state
        believed = core.task._frames.position_to_cell(state.flange_base_m)
        shift = state.flange_m - believed
        assert np.allclose(shift[0], drawn["base_shift_m"], atol=2.5e-3)  # the turn moves it by another 1.6 mm at most
        assert np.abs(shift).max() > 1e-5


@pytest.mark.parametrize(
    ("env_id", "randomization", "seed"),
    [
        (CARRY, "mild", 5),  # both arms draw the same lookahead
        (CARRY, "mild", 84),
        (SINE, "mild", 54),
        (CARRY, {"latency_s": 0.001}, 0),  # some rows draw no latency
        (SINE, {"skew_s": 0.002}, 0),
    ],
)
def test_a_row_is_independent_of_the_samples_of_others(env_id, randomization, seed):
    envs = [gym.make_vec(env_id, num_envs=n, randomization=randomization) for n in (1, 4)]
    first = [env.reset(seed=seed)[0][0] for env in envs]
    assert np.array_equal(*first)
    for k in range(15):
        action = 0.3 * np.sin(0.4 * k + np.arange(14 if env_id == CARRY else 12)).astype(np.float32)
        now = [env.step(np.tile(action, (env.num_envs, 1)))[0][0] for env in envs]
        assert np.array_equal(*now)


def test_varied_lists_the_perturbed_values():
    assert Randomization().varied == ()
    assert set(Randomization(skew_s=0.001, mass=0.1).varied) == {"latency_s", "mass_scale"}
    assert set(sample(PRESETS["wide"])) >= set(PRESETS["wide"].varied)
    assert Randomization(mass=np.float32(0.1)).mass == pytest.approx(0.1)


def test_a_base_shift_of_the_cell_is_not_observed():
    moved = dual_ur10.CellConfig(perturbation=dual_ur10.Perturbation(base_shift_m=(((0.01, 0, 0), (0, 0, 0)),)))
    (seen, info), (plain, other) = (gym.make(CARRY, cell=cell).reset(seed=0) for cell in (moved, "mujoco"))
    relative = np.s_[53:60]
    assert np.allclose(seen[relative], plain[relative], atol=1e-9)
    assert np.allclose(info["flange_m"][0] - other["flange_m"][0], [0.01, 0, 0])


def test_images_show_the_true_base_poses():
    turned = dual_ur10.CellConfig(perturbation=dual_ur10.Perturbation(base_turn_rad=((0.1, 0.0),)))
    core = gym.make(CARRY, cell=turned).unwrapped.core
    core.reset([np.random.default_rng(0)])
    _, data = core.cell_data(0)
    assert np.allclose(data.site("left/flange").xpos, core._state.flange_m[0, 0], atol=1e-9)
    assert np.allclose(data.site("right/flange").xpos, core._state.flange_m[0, 1], atol=1e-9)
