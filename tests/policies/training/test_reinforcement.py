"""PPO and SAC: complete trainings that take seconds."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import norm

pytest.importorskip("stable_baselines3")

from dual_ur10 import policies
from dual_ur10.envs.api.sb3_bridge import JointVecEnv, RewardDifferences, TwoAgentVecEnv
from dual_ur10.errors import SettingsError, TrainingError, UnknownNameError
from dual_ur10.policies.learned import checkpoint
from dual_ur10.policies.learned.signature import view_of
from dual_ur10.policies.training import folder, models, state
from dual_ur10.policies.training import reinforcement as reinforce
from dual_ur10.policies.training.settings import defaults
from dual_ur10.policies.training.train import resume, train
from tests.policies.training.small import small

SINE = "DualUR10/SineTracking-v0"


@pytest.fixture(scope="module")
def expert(tmp_path_factory):
    """Folder of a policy learned by cloning, which tests only read."""
    return train(small("bc", rounds=1), tmp_path_factory.mktemp("expert") / "bc")


@pytest.fixture(autouse=True)
def _few_checks(monkeypatch):
    """Most of the time of a SAC training goes into its checks, one after each few steps."""
    monkeypatch.setattr(reinforce, "_CHECKS", 4)


def sha_of(path):
    return checkpoint.read_manifest(path).weights_sha256


@pytest.mark.parametrize(("algorithm", "agents"), [("ppo", "joint"), ("ppo", "shared"), ("sac", "independent")])
def test_the_same_seed_gives_the_same_bits(tmp_path, drawn, algorithm, agents):
    asked = small(algorithm, agents, steps=64)
    first, second = train(asked, tmp_path / "a", threads=2), train(asked, tmp_path / "b", threads=1)
    assert sha_of(first) == sha_of(second)
    policy = policies.load(first, SINE, **asked.keywords)
    assert policy.manifest.agents == agents
    assert policy(np.zeros(94)).shape == (12,)
    assert policy.manifest.evaluation["episodes"] == 2
    assert state.load(tmp_path / "a" / "state")[1]["steps"] == 64  # of the environment
    if agents != "shared":  # of each algorithm
        other = small(algorithm, agents, steps=64, seed=1)
        assert sha_of(train(other, tmp_path / "c")) != sha_of(first)
    assert {"state", "training.json", "progress.csv"} <= {each.name for each in (tmp_path / "a").iterdir()}
    assert drawn[:2] == [tmp_path / "a" / "curve.png", tmp_path / "b" / "curve.png"]


def test_a_table_of_progress_is_kept_under_a_name_of_its_own(tmp_path):
    train(small("ppo", steps=64), tmp_path / "a")
    (tmp_path / "a" / "progress-2.csv").write_text("two")  # of which the first was removed
    first = (tmp_path / "a" / "progress.csv").read_text()
    resume(tmp_path / "a", steps=128)
    assert (tmp_path / "a" / "progress-3.csv").read_text() == first
    assert (tmp_path / "a" / "progress-2.csv").read_text() == "two"


def test_ppo_learns_from_the_concise_view(tmp_path):
    found = train(small("ppo", "shared", steps=64, keywords={"observation": "goals"}), tmp_path / "a")
    policy = policies.load(found, SINE, observation="goals", duration_s=1.0)
    assert policy.manifest.signature.view == "goals"
    assert policy(np.zeros(36)).shape == (12,)
    with pytest.raises(SettingsError, match="scripted policies read all fields"):
        train(small("dagger", keywords={"observation": "goals"}), tmp_path / "b")


@pytest.mark.parametrize(("algorithm", "agents"), [("sac", "joint"), ("ppo", "shared"), ("ppo", "independent")])
def test_a_policy_does_not_see_the_unseen_fields(tmp_path, algorithm, agents):
    """They have no effect on its actions, also after a training that was interrupted and continued."""
    train(small(algorithm, agents, steps=64, changes={"unseen": ("rotation",)}), tmp_path / "out")
    policy = policies.load(resume(tmp_path / "out", steps=128), SINE, duration_s=1.0)
    env = JointVecEnv("SineTracking", 8, threads=1)
    observation = env.reset()
    env.close()
    action = policy(observation)
    for index in range(94):
        other = observation.copy()
        other[:, index] += 0.01
        assert np.array_equal(policy(other), action) == (index in (31, 32, 33, 78, 79, 80)), index


@pytest.mark.parametrize("reward", ["shared", "individual"])
def test_each_arm_learns_from_the_reward_that_is_asked_for(tmp_path, monkeypatch, reward):
    """ "individual" is an arm's own; "shared" that of both, which is the mean of them."""
    seen = []
    real = TwoAgentVecEnv.step_wait

    def watched(self):
        found = real(self)
        seen.append((found[1].copy(), self.cells.core.agents.rewards.copy()))
        return found

    monkeypatch.setattr(TwoAgentVecEnv, "step_wait", watched)
    # Episodes of the training end after its last step: with the end of one, its rewards are gone.
    keywords = {"duration_s": 4.0, "arms": "left"}
    changes = {"reward": reward, "episode_steps": None}
    train(small("ppo", "shared", steps=64, keywords=keywords, changes=changes), tmp_path / "out")
    assert len(seen) == 32
    for got, own in seen:
        wanted = own if reward == "individual" else np.repeat(own.mean(axis=1, keepdims=True), 2, axis=1)
        np.testing.assert_allclose(got.reshape(-1, 2), wanted, atol=1e-12)
    assert any(abs(own[0, 0] - own[0, 1]) > 1e-3 for _, own in seen)


@pytest.mark.parametrize("reward", ["dense", "sparse"])
def test_the_reward_may_be_that_of_the_environments_keyword(tmp_path, monkeypatch, reward):
    earned = []
    real = TwoAgentVecEnv.step_wait
    monkeypatch.setattr(TwoAgentVecEnv, "step_wait", lambda self: earned.append(found := real(self)) or found)
    train(small("ppo", "shared", steps=64, keywords={"reward": reward}), tmp_path / "out")
    assert (np.concatenate([each[1] for each in earned]) > 0.0).any() == (reward == "dense")


@pytest.mark.parametrize(
    ("agents", "duration_s", "steps"), [("joint", 1.0, 12), ("independent", 1.0, 12), ("joint", 0.32, 8)]
)
def test_the_cells_of_a_training_do_not_end_their_episodes_together(tmp_path, monkeypatch, agents, duration_s, steps):
    """Neither where the training ends them, nor where the task does before."""
    kind, ends = JointVecEnv if agents == "joint" else TwoAgentVecEnv, []
    real = kind.step_wait

    def watched(self):
        found = real(self)
        ends.append(found[2][:: len(found[2]) // 8])
        return found

    monkeypatch.setattr(kind, "step_wait", watched)
    keywords, changes = {"duration_s": duration_s}, {"episode_steps": 12}
    train(small("ppo", agents, envs=8, steps=256, keywords=keywords, changes=changes), tmp_path / "out")
    assert len(ends) == 32
    assert max(each.sum() for each in ends) < 6
    first, *later = (np.flatnonzero(each) for each in np.array(ends).T)
    assert len({int(each[0]) for each in (first, *later)}) > 3
    assert all((np.diff(each) == steps).all() for each in (first, *later))


def test_a_network_that_sees_nothing_is_refused_before_anything_is_made(tmp_path):
    every = view_of("DualUR10/Handover-v0", {}).layout.names
    with pytest.raises(TrainingError, match="agents is 'joint'"):
        train(defaults("Handover", "ppo", "joint", changes={"unseen": every}), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("scaled", [False, True])
def test_a_network_may_see_unscaled_values_and_logs_keep_the_reward_of_the_task(scaled):
    settings = defaults("Handover", "ppo", changes={"scaled": scaled}).settings
    env = TwoAgentVecEnv("Handover", 2, reward="individual", threads=1, max_episode_steps=8)
    env.seed(0)
    env.reset()
    earned = sum(env.step(np.zeros((4, 7), dtype=np.float32))[1] for _ in range(8))
    _, around = models.make("ppo", env, settings, 0, unseen=[1])
    env.seed(0)
    around.reset()
    for _ in range(8):
        _, _, over, infos = around.step(np.zeros((4, 7)))
    assert over.all()
    moved = np.flatnonzero(around.obs_rms.mean != 0.0)
    assert 1 in moved
    assert (len(moved) > 1) == scaled
    assert [info["episode"]["r"] for info in infos] == pytest.approx(earned, rel=1e-4)  # not its changes
    env.close()


def test_an_unknown_reward_is_refused():
    with pytest.raises(SettingsError, match="reward"):
        small("ppo", changes={"reward": "both"})


def test_unknown_unseen_fields_of_reinforcement_are_refused(tmp_path):
    with pytest.raises(UnknownNameError, match="unknown observation field 'gripper_m'"):
        train(small("ppo", changes={"unseen": ("gripper_m",)}), tmp_path / "out")


@pytest.mark.parametrize(("envs", "steps", "done"), [(2, 9, 10), (1, 1, 2), (2, 40, 64)])
def test_a_training_shorter_than_an_update_of_ppo_is_one_update(tmp_path, envs, steps, done):
    train(small("ppo", envs=envs, steps=steps), tmp_path / "out")
    assert state.load(tmp_path / "out" / "state")[1]["steps"] == done  # an update has 32 steps at most


@pytest.mark.parametrize(("algorithm", "agents"), [("ppo", "independent"), ("sac", "joint")])
def test_an_interrupted_training_continues_from_its_state(tmp_path, monkeypatch, algorithm, agents):
    real, saved = reinforce.Reinforcer.watch, []

    def interrupted(self, infos, steps):
        real(self, infos, steps)
        if steps >= 80:
            for k, (model, around) in enumerate(self._models):
                saved.append(models.tensors_of(model, around, f"{k}."))
            raise KeyboardInterrupt

    monkeypatch.setattr(reinforce.Reinforcer, "watch", interrupted)
    asked = small(algorithm, agents, steps=160)
    with pytest.raises(KeyboardInterrupt):
        train(asked, tmp_path / "out")
    monkeypatch.undo()
    begun = []
    restore = models.restore

    def watched(model, around, prefix, tensors):
        restore(model, around, prefix, tensors)
        begun.append(models.tensors_of(model, around, prefix))

    monkeypatch.setattr(models, "restore", watched)
    path = resume(tmp_path / "out")
    assert len(begun) == len(saved) == (2 if agents == "independent" else 1)
    for before, after in zip(saved, begun, strict=True):
        assert before.keys() == after.keys()
        for name, value in before.items():
            np.testing.assert_array_equal(after[name], value, err_msg=name)
    assert any("optimizer/state" in name for name in begun[0])
    assert state.load(tmp_path / "out" / "state")[1]["steps"] >= 160
    assert path.name == "policy"


def test_ppo_can_begin_with_the_result_of_dagger(tmp_path):
    expert = train(small("dagger", changes={"hidden": (16,)}), tmp_path / "dagger")
    asked = small("ppo", init=str(expert), steps=32)
    seen = []
    learned = policies.load(expert, SINE, **asked.keywords)
    env = JointVecEnv("SineTracking", 2, **asked.keywords)
    model, around = models.make("ppo", env, asked.settings, 0)
    models.begin_with([(model, around)], learned)
    rng = np.random.default_rng(0)
    env.seed(0)
    observation = env.reset()
    for _ in range(10):
        wanted = learned(observation)
        found, _ = model.predict(around.normalize_obs(observation), deterministic=True)
        np.testing.assert_allclose(found, wanted, atol=1e-5)
        seen.append(wanted)
        observation, *_ = env.step(rng.uniform(-1, 1, (2, 12)).astype(np.float32))
    assert np.abs(np.array(seen)).max() > 0.05
    env.close()
    path = train(asked, tmp_path / "ppo")
    assert checkpoint.read_manifest(path).training["from_checkpoint"] is True


def test_the_value_function_learns_first(tmp_path, expert, monkeypatch):
    """With a checkpoint the policy does not move before it; the result is no worse than the checkpoint."""
    seen = []
    real = reinforce.Reinforcer.explore

    def watched(self, model):
        real(self, model)
        seen.append({name: each.detach().clone() for name, each in model.policy.named_parameters()})
        assert model.target_kl == 0.5

    monkeypatch.setattr(reinforce.Reinforcer, "explore", watched)
    changes = {"critic_first": 0.5, "target_kl": 0.5, "first_std": 0.05, "last_std": 0.05}
    path = train(small("ppo", init=str(expert), steps=128, changes=changes), tmp_path / "out")
    acts = [name for name in seen[0] if "policy_net" in name or "action_net" in name]
    values = [name for name in seen[0] if "value_net" in name]
    assert len(acts) == len(values) == 4
    first, second, third, fourth = seen
    for name in acts:
        assert first[name].equal(second[name]), name
        assert second[name].equal(third[name]), name
        assert not third[name].equal(fourth[name]), name
    assert not any(first[name].equal(second[name]) for name in values)
    checks = state.load(tmp_path / "out" / "state")[1]["checks"]
    assert [each["steps"] for each in checks] == [0, 32, 64, 96, 128]
    for each in checks[1:3]:  # of the same policy; its normaliser hardly moves
        assert each["mean_return"] == pytest.approx(checks[0]["mean_return"], rel=0.01)
    assert checkpoint.read_manifest(path).evaluation["mean_return"] >= checks[0]["mean_return"]


@pytest.mark.parametrize(
    ("algorithm", "agents", "hidden", "match"),
    [
        ("ppo", "joint", (8,), "94 - 16 - 12 tanh clip; this training makes joint, 94 - 8 - 12"),
        ("ppo", "independent", (16,), "is joint.* makes independent, 47 - 16 - 6"),
        ("dagger", "joint", (8,), "makes joint, 94 - 8 - 12"),
        ("sac", "joint", (16,), "use ppo"),
    ],
)
def test_a_misfit_is_refused_before_anything_is_made(tmp_path, expert, algorithm, agents, hidden, match):
    with pytest.raises((TrainingError, SettingsError), match=match):
        train(
            small(algorithm, agents, init=str(expert), steps=32, changes={"hidden": hidden}),
            tmp_path / "out",
        )
    assert not (tmp_path / "out").exists()


def test_a_training_without_a_normaliser_continues_without(tmp_path, expert):
    learned = checkpoint.load(expert)
    checkpoint.save(tmp_path / "bare", learned.layers, dataclasses.replace(learned.manifest, normalisers=()))
    asked = small("ppo", init=str(tmp_path / "bare"), steps=32)
    path = train(asked, tmp_path / "out")
    assert checkpoint.read_manifest(path).normalisers == ()
    model, around = models.make("ppo", JointVecEnv("SineTracking", 2, **asked.keywords), asked.settings, 0)
    assert around.norm_obs
    models.restore(model, around, "0.", state.load(tmp_path / "out" / "state")[0])
    assert around.norm_obs is False
    around.close()


def test_divergence_is_a_training_error(tmp_path, monkeypatch):
    real = reinforce.Reinforcer.watch

    def spoiled(self, infos, steps):
        real(self, infos, steps)
        if steps >= 40:
            for each in self._models[0][0].policy.parameters():
                each.data.fill_(float("nan"))

    monkeypatch.setattr(reinforce.Reinforcer, "watch", spoiled)
    with pytest.raises(TrainingError, match=r"diverged after \d+ steps.* smaller learning_rate, found 0.001"):
        train(small("ppo", steps=128), tmp_path / "out")


def test_other_errors_are_raised_unchanged(tmp_path, monkeypatch):
    def broken(self, infos, steps):
        raise ValueError("something else")

    monkeypatch.setattr(reinforce.Reinforcer, "watch", broken)
    with pytest.raises(ValueError, match="something else"):
        train(small("ppo", steps=128), tmp_path / "out")


def test_the_state_of_another_training_is_refused(tmp_path):
    train(small("ppo", steps=64), tmp_path / "a")
    train(small("ppo", steps=64, changes={"hidden": (8,)}), tmp_path / "b")
    mixed = tmp_path / "b" / "state" / "tensors.safetensors"
    mixed.write_bytes((tmp_path / "a" / "state" / "tensors.safetensors").read_bytes())
    with pytest.raises(TrainingError, match="not of this training"):
        resume(tmp_path / "b", steps=128)


def test_the_best_checks_are_kept(tmp_path, monkeypatch):
    ranks = iter([0.2, 0.9, 0.5, 0.1])
    real = folder.check_of

    def ranked(evaluation, steps, seconds):
        check = real(evaluation, steps, seconds)
        object.__setattr__(check, "success_rate", next(ranks, 0.0))
        return check

    monkeypatch.setattr(folder, "check_of", ranked)
    path = train(small("ppo", steps=128), tmp_path / "out")
    kept = sorted(each.name for each in (tmp_path / "out").glob("steps-*"))
    assert kept == ["steps-000000032", "steps-000000064"]
    assert sha_of(path) == sha_of(tmp_path / "out" / "steps-000000064")


def test_exploration_and_learning_rate_decay_over_the_whole_training(tmp_path, monkeypatch):
    widths, rates = [], []
    real = reinforce.Reinforcer.explore

    def watched(self, model):
        real(self, model)
        widths.append(float(model.policy.log_std.exp().mean()))
        rates.append(model.lr_schedule(1.0))

    monkeypatch.setattr(reinforce.Reinforcer, "explore", watched)
    changes = {"first_std": 0.4, "last_std": 0.1, "learning_rate": 0.01, "episode_steps": 7}
    asked = small("ppo", steps=320, changes=changes)
    half = {"steps": 160}
    train(dataclasses.replace(asked, **half), tmp_path / "half")
    assert widths[0] == pytest.approx(0.4)
    assert rates[0] == pytest.approx(0.01)
    assert widths == sorted(widths, reverse=True)
    assert rates == sorted(rates, reverse=True)
    shown = (tmp_path / "half" / "progress.csv").read_text().splitlines()
    column = shown[0].split(",").index("rollout/ep_len_mean")
    lengths = [float(each) for each in (line.split(",")[column] for line in shown[1:]) if each]
    assert lengths == sorted(lengths)  # of all episodes so far, whose first ones are shorter
    assert 6.0 < lengths[-1] < 7.0
    # A training that is made longer continues where a longer one would be.
    widths.clear()
    resume(tmp_path / "half", steps=320)
    assert widths[0] == pytest.approx(0.4 * 0.25 ** (0.5 / 0.9), rel=1e-3)
    assert widths[-1] == pytest.approx(0.1, rel=0.05)
    assert np.all(np.diff(widths) <= 0)


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_the_learning_rate_falls_to_zero_with_the_share_that_is_done(algorithm):
    env, done = TwoAgentVecEnv("SineTracking", 1, threads=1), [0.0]
    asked = small(algorithm, changes={"learning_rate": 0.01})
    model, _ = models.make(algorithm, env, asked.settings, 0, lambda: done[0])
    env.close()
    rates = []
    for done[0] in (0.0, 0.25, 1.0):
        rates.append(model.lr_schedule(1.0))
    assert rates == pytest.approx([0.01, 0.0075, 0.0])


def test_the_cost_of_refusals_grows_over_the_whole_training(tmp_path, monkeypatch):
    ratios = []
    real = RewardDifferences.step_wait

    def watched(self):
        ratios.append(self._refusals())
        return real(self)

    monkeypatch.setattr(RewardDifferences, "step_wait", watched)
    changes = {"differences": True, "refusals": 0.5}
    train(small("ppo", steps=320, changes=changes), tmp_path / "out")
    assert ratios[0] == 0.0
    assert np.all(np.diff(ratios) >= 0)
    assert 0.4 < ratios[-1] < 0.5


@pytest.mark.parametrize("kind", [JointVecEnv, TwoAgentVecEnv])
@pytest.mark.parametrize(("task", "ratios"), [("Handover", [1.0] * 6 + [3.0]), ("SineTracking", [1.0] * 6)])
@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_grippers_explore_as_wide_as_is_asked_for(tmp_path, algorithm, kind, task, ratios):
    asked = defaults(task, algorithm, "shared", changes={"first_std": 0.2, "last_std": 0.1, "gripper_std": 3.0})
    learner = reinforce.Reinforcer(folder.TrainingFolder.create(tmp_path / "out", asked))
    env = kind(task, 1, threads=1)
    model, _ = models.make(algorithm, env, asked.settings, 0)
    for steps, std in ((0, 0.2), (asked.steps, 0.1), (0, 0.2)):
        learner.steps = steps
        learner.explore(model)
        widths = std * np.tile(ratios, env.action_space.shape[0] // len(ratios))
        if algorithm == "ppo":
            assert model.policy.log_std.exp().numpy() == pytest.approx(widths)
        else:
            assert model.target_entropy == pytest.approx(norm.entropy(scale=widths).sum(), abs=1e-4)
    env.close()


def test_sac_begins_near_zero_and_as_wide_as_is_asked_for():
    env = TwoAgentVecEnv("SineTracking", 32, threads=1)
    model, around = models.make("sac", env, small("sac", changes={"first_std": 0.05}).settings, 0)
    observation = around.reset()
    sampled = np.array([model.predict(observation)[0] for _ in range(50)])
    env.close()
    assert np.abs(sampled.mean(axis=(0, 1))).max() < 0.02
    assert sampled.std(axis=(0, 1)) == pytest.approx(0.05, rel=0.1)
