"""Minari datasets: collection and reading."""

from __future__ import annotations

import json
import sys

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10 import policies
from dual_ur10.envs.api.agent_dict import AgentDictWrapper
from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.errors import ActionError, DatasetError, SettingsError
from dual_ur10.policies import evaluate
from dual_ur10.policies.learned.signature import view_of
from dual_ur10.policies.training.dataset import collect, read_dataset
from dual_ur10.sim2real.cell_file.reference import starting_text

minari = pytest.importorskip("minari")
h5py = pytest.importorskip("h5py")

SINE = "DualUR10/SineTracking-v0"
KEYWORDS = {"duration_s": 2.0, "action_latency_ticks": 5, "randomization": "mild"}


@pytest.fixture(autouse=True)
def _own_folder(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("datasets")))


def made(name="ur10/sine/scripted-v0", **given):
    given = {"episodes": 3, "envs": 2, "seed": 4, "env_kwargs": KEYWORDS, **given}
    return collect(given.pop("env_id", "SineTracking"), name, **given)


def test_minari_alone_reads_a_dataset():
    counts_seen = []
    made(on_progress=lambda *counts: counts_seen.append(counts))
    dataset = minari.load_dataset("ur10/sine/scripted-v0")
    assert dataset.total_episodes == 3
    assert dataset.total_steps == 150
    assert counts_seen == [(2, 2), (3, 3)]
    assert dataset.spec.env_spec.id == SINE
    assert dataset.spec.env_spec.kwargs["action_latency_ticks"] == 5
    alone = evaluate(SINE, "scripted", episodes=3, num_envs=1, seed=4, env_kwargs=KEYWORDS)
    for episode, wanted in zip(dataset.iterate_episodes(), alone.episodes, strict=True):
        assert set(episode.observations) == set(episode.actions) == {"left", "right"}
        assert episode.observations["left"].shape == (51, 47)
        assert episode.actions["right"].shape == (50, 6)
        assert episode.rewards.sum() == pytest.approx(wanted.total_reward, abs=1e-9)
        assert episode.infos["is_success"][-1] == wanted.success
    metadata = list(dataset.storage.get_episode_metadata(range(3)))
    assert [each["success"] for each in metadata] == ["true"] * 3
    assert [each["seed"] for each in metadata] == [4, 5, 6]


@pytest.mark.parametrize("failure", [KeyboardInterrupt, RuntimeError])
@pytest.mark.parametrize("after", [60, 120])
def test_the_end_of_a_collection_keeps_the_episodes_that_had_ended(monkeypatch, failure, after):
    whole = made("ur10/sine/whole-v0", env_kwargs={"duration_s": 2.0})
    policy, calls = policies.load("scripted", SINE), []

    def failing(observation):
        calls.append(1)
        if len(calls) > after:
            raise failure
        return policy(observation)

    failing.reset = policy.reset
    monkeypatch.setattr("dual_ur10.policies.training.dataset.load_named", lambda *_: failing)
    with pytest.raises(failure):
        made(episodes=5, env_kwargs={"duration_s": 2.0})
    found = list(minari.load_dataset("ur10/sine/scripted-v0").iterate_episodes())
    assert len(found) == 2 * (after // 50)
    for episode, wanted in zip(found, whole.iterate_episodes(), strict=False):
        assert np.array_equal(episode.observations["left"], wanted.observations["left"])


def test_an_interrupt_keeps_the_episodes_that_ended_before_the_others_of_their_batch(monkeypatch):
    step, calls = DualArmVectorEnv.step, []

    def uneven(self, action):
        calls.append(1)
        observation, reward, terminated, truncated, info = step(self, action)
        if len(calls) == 20:
            raise KeyboardInterrupt
        return observation, reward, terminated | (np.arange(2) == 1) & (len(calls) == 10), truncated, info

    monkeypatch.setattr(DualArmVectorEnv, "step", uneven)
    with pytest.raises(KeyboardInterrupt):
        made()
    dataset = minari.load_dataset("ur10/sine/scripted-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (1, 10)
    (metadata,) = dataset.storage.get_episode_metadata([0])
    assert metadata["seed"] == 5


def test_the_recovered_environment_has_the_spaces_of_the_data_and_repeats_them():
    made(episodes=1, env_kwargs={"duration_s": 0.4, "action_latency_ticks": 5})
    dataset = minari.load_dataset("ur10/sine/scripted-v0")
    env = dataset.recover_environment()
    assert env.observation_space == dataset.observation_space
    assert env.action_space == dataset.action_space
    (episode,) = dataset.iterate_episodes()
    found = [env.reset(seed=4)[0]]
    for k, reward in enumerate(episode.rewards):
        observation, *rest = env.step({arm: actions[k] for arm, actions in episode.actions.items()})
        found.append(observation)
        assert rest[0] == reward
    assert rest[1:3] == [False, True]
    for arm in ("left", "right"):
        assert np.array_equal([each[arm] for each in found], episode.observations[arm])
    with pytest.raises(ActionError, match="left"):
        env.step(np.zeros(12))
    env.close()


@pytest.mark.filterwarnings("ignore")  # of jax about itself
@pytest.mark.parametrize("by_agent", [False, True])
def test_minaris_own_collector_collects(by_agent):
    pytest.importorskip("jax", reason="needs the extra data")
    env = gym.make(SINE, duration_s=0.2, action_latency_ticks=5)
    collector = minari.DataCollector(AgentDictWrapper(env) if by_agent else env, record_infos=by_agent)
    for seed in range(2):
        collector.reset(seed=seed)
        over = False
        while not over:
            _, _, terminated, truncated, _ = collector.step(collector.action_space.sample())
            over = terminated or truncated
    dataset = collector.create_dataset("ur10/own-v0")
    recovered = dataset.recover_environment()
    assert dataset.total_steps == 10
    assert dataset.observation_space == recovered.observation_space == collector.observation_space
    assert dataset.action_space == recovered.action_space == collector.action_space
    if by_agent:
        assert next(dataset.iterate_episodes()).infos["reference_m"].shape == (6, 2, 3)
        assert (
            read_dataset("ur10/own-v0", view_of(SINE, {"duration_s": 0.2, "action_latency_ticks": 5}))[0].shape[1] == 94
        )


def test_read_samples_are_the_recorded_ones():
    made(episodes=1)
    observation, action, episode, _ = read_dataset("ur10/sine/scripted-v0", view_of(SINE, KEYWORDS))
    policy = policies.load("scripted", SINE, **KEYWORDS)
    assert observation.shape == (50, 94)
    assert not episode.any()
    expected = np.array([policy(row) for row in observation.astype(np.float64)])
    np.testing.assert_allclose(expected, action, atol=2e-4)  # single precision of what was seen


def test_only_successful_episodes_are_read():
    made("ur10/other-v0", policy="scripted", episodes=2)
    view = view_of(SINE, KEYWORDS)
    whole, _, episode, _ = read_dataset("ur10/other-v0", view)
    dataset = minari.load_dataset("ur10/other-v0")
    dataset.storage.update_episode_metadata([{"success": "false"}], [0])
    half, *_ = read_dataset("ur10/other-v0", view)
    assert (len(whole), len(half)) == (100, 50)
    assert episode.tolist() == [0] * 50 + [1] * 50
    np.testing.assert_array_equal(half, whole[50:])


def test_a_dataset_without_success_is_refused():
    made(episodes=2)
    storage = minari.load_dataset("ur10/sine/scripted-v0").storage
    view = view_of(SINE, KEYWORDS)
    storage.update_episode_metadata([{"success": "false"}] * 2, [0, 1])
    with pytest.raises(DatasetError, match="2 episodes, of which none succeeded"):
        read_dataset("ur10/sine/scripted-v0", view)
    storage.update_episode_metadata([{"success": "unknown"}] * 2, [0, 1])
    assert len(read_dataset("ur10/sine/scripted-v0", view)[0]) == 100


def test_a_damaged_dataset_is_refused(tmp_path):
    made(episodes=2)
    path = minari.load_dataset("ur10/sine/scripted-v0").storage.data_path / "main_data.hdf5"
    view, whole = view_of(SINE, KEYWORDS), path.read_bytes()
    with h5py.File(path, "a") as file:
        del file["episode_1"]
    with pytest.raises(DatasetError, match=r"ur10/sine/scripted-v0 .*cannot be read"):
        read_dataset("ur10/sine/scripted-v0", view)
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DatasetError, match=r"ur10/sine/scripted-v0.* cannot be read"):
        read_dataset("ur10/sine/scripted-v0", view)


@pytest.mark.parametrize("policy", ["zero", "random"])
def test_every_named_policy_can_be_collected_from(policy):
    dataset = made(policy=policy, episodes=2)
    actions = next(iter(dataset.iterate_episodes())).actions["left"]
    assert actions.any() == (policy == "random")


def test_keywords_of_the_vector_form_are_no_keywords_of_the_dataset():
    dataset = made(policy="zero", env_kwargs={**KEYWORDS, "max_episode_steps": 5, "threads": 1})
    assert dataset.total_steps == 15
    assert dataset.recover_environment().spec.kwargs.keys() == {"task", *KEYWORDS}


@pytest.mark.parametrize(
    ("keywords", "match"),
    [
        ({"observation": "pixels"}, "needs observation='state'"),
        ({"cell": "lab.toml"}, "not simulated.*record a rollout"),
    ],
)
def test_only_states_in_simulation_are_collected(tmp_path, monkeypatch, keywords, match):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab.toml").write_text(starting_text("emulated", None, None, "cb3", None, "lab.toml"))
    with pytest.raises(SettingsError, match=match):
        made(env_kwargs=keywords)


@pytest.mark.parametrize(
    ("other", "match"),
    [
        ({"env_id": "DualUR10/Handover-v0", "duration_s": None}, "env_id"),
        ({"action_latency_ticks": 0}, "rate"),
        ({"policy_rate_hz": 12.5}, "rate"),
        ({"compensate_lag": False}, "actions"),
        ({"action_mode": "joint_position"}, "action"),
    ],
)
def test_a_dataset_of_another_environment_is_refused(other, match):
    made()
    env_id = other.pop("env_id", SINE)
    keywords = {name: value for name, value in {**KEYWORDS, **other}.items() if value is not None}
    with pytest.raises(DatasetError, match=f"with {match}"):
        read_dataset("ur10/sine/scripted-v0", view_of(env_id, keywords))


def test_nothing_is_overwritten():
    made()
    with pytest.raises(DatasetError, match="exists"):
        made()
    assert minari.load_dataset("ur10/sine/scripted-v0").total_episodes == 3


@pytest.mark.parametrize("name", ["", "no version", "noversion", "ur10/carry", "a/b", "../x-v0", "a b-v0"])
def test_illegal_names_are_refused_before_anything_runs(name, monkeypatch):
    monkeypatch.setattr("dual_ur10.policies.evaluation.evaluate.load_named", lambda *_, **__: pytest.fail("it ran"))
    with pytest.raises(DatasetError, match="no name of a dataset"):
        made(name)


@pytest.mark.parametrize("name", ["no/such-v0", "nonsense"])
def test_an_absent_dataset_is_refused(name):
    with pytest.raises(DatasetError, match="make one with `collect`"):
        read_dataset(name, view_of(SINE, KEYWORDS))


def test_a_dataset_without_an_environment_is_refused():
    made(episodes=1)
    path = minari.load_dataset("ur10/sine/scripted-v0").storage.data_path / "metadata.json"
    metadata = json.loads(path.read_text())
    for spec in (None, "", "{}", '{"id": "CartPole-v1"}'):
        path.write_text(json.dumps({**metadata, "env_spec": spec}))
        with pytest.raises(DatasetError, match=r"does not specify its environment|cannot be read"):
            read_dataset("ur10/sine/scripted-v0", view_of(SINE, KEYWORDS))


def test_a_dataset_without_spaces_makes_no_environment(tmp_path, monkeypatch):
    made(episodes=1)
    (tmp_path / "hostile.py").write_text("def make(**_): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = minari.load_dataset("ur10/sine/scripted-v0").storage.data_path / "metadata.json"
    metadata = json.loads(path.read_text())
    spec = json.dumps({**json.loads(metadata["env_spec"]), "entry_point": "hostile:make"})
    for name in ("observation_space", "action_space"):
        path.write_text(json.dumps({**metadata, "env_spec": spec} | {name: None}))
        with pytest.raises(DatasetError, match="does not state its spaces"):
            read_dataset("ur10/sine/scripted-v0", view_of(SINE, KEYWORDS))
        path.write_text(json.dumps({key: each for key, each in {**metadata, "env_spec": spec}.items() if key != name}))
        with pytest.raises(DatasetError, match="does not state its spaces"):
            read_dataset("ur10/sine/scripted-v0", view_of(SINE, KEYWORDS))
    assert "hostile" not in sys.modules


def test_cloning_learns_from_a_dataset_alone(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    from dual_ur10.policies.learned import checkpoint
    from dual_ur10.policies.training import imitation as imitate
    from dual_ur10.policies.training.train import resume, train
    from tests.policies.training.small import small

    made(episodes=4)
    asked = small("bc", dataset="ur10/sine/scripted-v0")
    monkeypatch.setattr(imitate, "gather", lambda *_, **__: pytest.fail("it asked the expert"))
    path = train(asked, tmp_path / "out")
    manifest = checkpoint.read_manifest(path)
    assert manifest.training["from_dataset"] is True
    assert (manifest.training["steps"], manifest.training["samples"]) == (0, 200)
    assert "ur10/sine" not in (path / "manifest.json").read_text()

    with monkeypatch.context() as patch:
        patch.setattr(imitate, "Fit", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            train(asked, tmp_path / "interrupted")
    for out in ("interrupted", "out"):
        again = checkpoint.read_manifest(resume(tmp_path / out))
        assert again.weights_sha256 == manifest.weights_sha256


def test_dagger_begins_with_a_dataset(tmp_path):
    pytest.importorskip("stable_baselines3")
    from dual_ur10.policies.learned import checkpoint
    from dual_ur10.policies.training.train import train
    from tests.policies.training.small import STEPS, small

    made(episodes=4)
    path = train(small("dagger", rounds=2, dataset="ur10/sine/scripted-v0"), tmp_path / "out")
    assert len(list(path.parent.glob("samples-*"))) == 3
    saved = [checkpoint.read_manifest(each).training for each in path.parent.glob("steps-*")]
    assert {(each["steps"], each["samples"]) for each in saved} <= {
        (0, 200),
        (2 * STEPS, 200 + 2 * STEPS),
        (4 * STEPS, 200 + 4 * STEPS),
    }
    assert any(each["steps"] == 0 for each in saved)  # the learner drives from the beginning


def test_a_misfit_is_refused_before_anything_is_made(tmp_path):
    pytest.importorskip("stable_baselines3")
    from dual_ur10.policies.training.train import train
    from tests.policies.training.small import small

    made(episodes=1)
    with pytest.raises(DatasetError, match="with rate"):
        train(small("bc", dataset="ur10/sine/scripted-v0", keywords={"action_latency_ticks": 0}), tmp_path / "b")
    with pytest.raises(DatasetError, match="no whole dataset"):
        train(small("dagger", dataset="no/such-v0"), tmp_path / "b")
    assert not (tmp_path / "b").exists()
