"""What was recorded plays again: to the last bit in simulation, and nowhere that it does not fit."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10 import ENV_IDS, TYPICAL_PERTURBATION, ArmMount, CellConfig, ServojProfile
from dual_ur10.assets.obstacles import Box
from dual_ur10.assets.prop import HeldCapsule, Prop
from dual_ur10.assets.settings import Equipment
from dual_ur10.envs.sim.mujoco_cell import make_mujoco_cell
from dual_ur10.envs.tasks.sine_tracking.settings import SineSettings
from dual_ur10.envs.tasks.sine_tracking.task import SineTracking
from dual_ur10.envs.tasks.task import SceneRequirements
from dual_ur10.errors import CheckpointError, RecordingError
from dual_ur10.ids import TASKS
from dual_ur10.policies.learned.signature import view_of_env, view_of_signature
from dual_ur10.policies.policy import Policy
from dual_ur10.registration import register
from dual_ur10.sim2real.analysis.compare import compare
from dual_ur10.sim2real.analysis.fit import fit
from dual_ur10.sim2real.analysis.reconstruction import check_replayable, generator_text, keywords_of, resets_of
from dual_ur10.sim2real.analysis.replay import RecordedPolicy, replay
from dual_ur10.sim2real.analysis.tracks import flange_of
from dual_ur10.sim2real.cell.cell_kinds import CELL_KINDS, CellKind
from dual_ur10.sim2real.recording.header import mounts_of
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.run import Run
from tests.assets.test_arm_shape import OWN
from tests.sim2real.analysis.made import DH, header
from tests.sim2real.analysis.recorded import record
from tests.soak import scaled
from ur_core.mjcf.camera import Camera
from ur_core.mjcf.gains import STIFF, Gains

EYE = Camera("eye", (0.0, 0.1, 0.3), (0.0, 0.0, 0.0))
SINE = ENV_IDS[0]
STEPS = scaled(400)

CELL = CellConfig(
    perturbation=TYPICAL_PERTURBATION,
    left=ArmMount((-0.75, 0.6, 0.0), 0.01),
    servoj=ServojProfile("cb3", 0.04, 1500.0),
    obstacles=(Box(name="post", position_m=(0.0, 1.6, 0.4), size_m=(0.2, 0.2, 0.2)),),
    gains=OWN,
    speed_rad_s=1.0,
)


@pytest.fixture(scope="module")
def sine(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return record(tmp_path_factory.mktemp("runs") / "sine", SINE, [5, None, 7], STEPS)


MILD = {"randomization": {"preset": "mild", "mass": 0.1}, "action_mode": "joint_position"}
PERTURBED = {"cell": CELL, "action_latency_ticks": 3}


@pytest.mark.parametrize(
    ("env_id", "keywords"),
    [
        *((env_id, {}) for env_id in ENV_IDS if TASKS[env_id].scripted),
        ("DualUR10/SyncCarry-v0", MILD),
        ("DualUR10/Handover-v0", PERTURBED),
    ],
)
def test_a_simulated_run_is_replayed_to_the_last_bit(tmp_path: Path, env_id: str, keywords: dict[str, Any]) -> None:
    run = record(tmp_path / "run", env_id, [5, None], STEPS, **keywords)
    for number in range(2):
        found = replay(run, episode=number)
        assert found.difference == ""
        assert found.is_exact
        assert found.steps == found.recorded == STEPS
        assert found.equal_targets == 5 * STEPS
        assert (found.q_rad == run.episodes[number].q_rad).all()
        assert (found.targets_rad == run.episodes[number].targets_rad).all()


def test_without_the_generator_seeds_suffice(sine: Run) -> None:
    forgetful = replace(sine, events=[])
    assert resets_of(forgetful, 1) == [5, None]
    assert resets_of(forgetful, 2) == [7]
    for number in range(3):
        assert replay(forgetful, episode=number).is_exact
    unseeded = replace(forgetful, episodes=[replace(each, seed=None) for each in sine.episodes])
    assert resets_of(unseeded, 1) == [5, None]  # that of the header
    assert generator_text(forgetful, 0) is None


@pytest.mark.parametrize("what", ["targets", "joints", "reward"])
def test_a_bit_that_differs_is_named(sine: Run, what: str) -> None:
    first = sine.episodes[0]
    if what == "targets":
        rows = first.targets_rad.copy()
        rows[4, 2, 1, 3] = np.nextafter(rows[4, 2, 1, 3], 9.0)
        changed, words = replace(first, targets_rad=rows), "targets in step 4, tick 2 differ: right wrist_1_joint"
    elif what == "joints":
        rows = first.q_rad.copy()
        rows[6, 0, 1] = np.nextafter(rows[6, 0, 1], 9.0)
        changed, words = replace(first, q_rad=rows), "joints in step 5 differ: left shoulder_lift_joint"
    else:
        rewards = first.reward.copy()
        rewards[3] += 1e-12
        changed, words = replace(first, reward=rewards), "the reward in step 3"
    found = replay(replace(sine, episodes=[changed]))
    assert words in found.difference
    assert not found.is_exact
    assert found.steps == STEPS
    assert found.equal_targets == 5 * STEPS - (what == "targets")


def test_another_action_gives_other_targets(sine: Run) -> None:
    actions = sine.episodes[0].action.copy()
    actions[7, 0] += 0.1
    found = replay(replace(sine, episodes=[replace(sine.episodes[0], action=actions)]))
    assert "targets in step 7" in found.difference


def test_actions_are_compared_where_another_cell_moves(sine: Run) -> None:
    found = replay(sine, CellConfig(perturbation=TYPICAL_PERTURBATION))
    assert found.is_exact  # of the targets, which go on from commands and not from what is measured
    assert found.equal_targets == 5 * STEPS
    assert not (found.q_rad == sine.episodes[0].q_rad).all()


def test_another_motion_is_ended(sine: Run) -> None:
    episode = sine.episodes[0]
    # As if a tighter limit had kept the arms behind, more and more.
    behind = episode.targets_rad - 0.003 * np.arange(STEPS)[:, None, None, None]
    changed = replace(sine, episodes=[replace(episode, targets_rad=behind)])
    found = replay(changed, CellConfig())
    assert "targets in step 7 are 0.021 rad from the recorded ones, allowed at most 0.02 rad" in found.ended_by
    assert found.steps == len(found.targets_rad) == 8
    assert found.success is None
    assert "targets in step 1, tick 0 differ" in found.difference
    assert replay(changed).steps == STEPS  # where nothing but numbers can differ


def test_a_run_of_controllers_is_replayed_in_simulation(sine: Run) -> None:
    emulated = replace(sine, header=replace(sine.header, source="emulated", kwargs={"cell": "gone.toml"}))
    found = replay(emulated)
    assert found.is_exact
    slow = "kind = 'emulated'\nspeed_factor = 0.5\n[left]\nhost='127.0.0.2'\n[right]\nhost='127.0.0.3'\n"
    found = replay(replace(emulated, header=replace(emulated.header, cell_file=slow)))
    assert found.steps == STEPS


def played(folder: Path, env_id: str, **keywords: Any) -> Run:
    """Record five steps that hardly move."""
    with gym.make(env_id, record=folder, disable_env_checker=True, **keywords) as env:
        env.reset(seed=3)
        for _ in range(5):
            env.step(np.full(env.action_space.shape, 0.1, dtype=np.float32))
    return read_run(next(folder.iterdir()))


@pytest.mark.parametrize("kind", ["echo", "lab"])
def test_the_recorded_cell_of_another_kind_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    lab = CellKind(factory=f"{make_mujoco_cell.__module__}:{make_mujoco_cell.__name__}", controllers=True)
    monkeypatch.setitem(CELL_KINDS, "lab", lab)
    cell = replace(CELL, kind=kind, perturbation=CellConfig().perturbation, speed_factor=0.5)
    run = played(tmp_path, SINE, cell=cell)
    assert run.header.source == kind
    monkeypatch.delitem(CELL_KINDS, "lab")  # nothing of the package that brought it is needed
    assert keywords_of(run.header)["cell"] == replace(cell, kind="mujoco")
    assert replay(run).equal_targets == 25


@dataclass(frozen=True)
class PropSettings(SineSettings):
    """Keywords that are dataclasses: one of several, and in tuples and mappings."""

    prop: Box | Prop | None = None
    pairs: tuple[tuple[HeldCapsule | None, int], ...] = ()
    named: Mapping[str, HeldCapsule] | None = None
    gains: Gains = STIFF


class WithProps(SineTracking):
    """SineTracking beside a prop of its keywords."""

    settings_type: ClassVar[Any] = PropSettings

    @classmethod
    def requirements(cls, settings: Any) -> SceneRequirements:
        props = () if settings.prop is None else (settings.prop,)
        return SceneRequirements(Equipment(props=props), gains=settings.gains)


def test_keywords_that_are_dataclasses_are_those_of_the_replay(tmp_path: Path, registries: None) -> None:
    register("Lab/WithProps-v0")(WithProps)
    body = "<body pos='0 0 .03'><freejoint/><geom type='box' size='.03 .03 .03' mass='.2'/></body>"
    capsule = HeldCapsule((0, 0, 0), (0, 0, 0.1), 0.02)
    mjcf = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    prop = Prop(name="box", mjcf=mjcf, held=(capsule, None), noise=0.5, cameras=(EYE,))
    keywords = {"prop": prop, "pairs": ((capsule, 1), (None, 2)), "named": {"a": capsule}, "gains": OWN}
    run = played(tmp_path, "Lab/WithProps-v0", cameras=(EYE, "front"), **keywords)
    assert keywords_of(run.header) == {**keywords, "cameras": (EYE, "front"), "action_latency_ticks": 0}
    found = replay(run)
    assert found.is_exact, found.difference
    with gym.make("Lab/WithProps-v0", **keywords) as env:
        signature, model = view_of_env(env).signature, env.unwrapped.core.cell.model_and_data(0)[0]
    assert model.actuator_gainprm[:6, 0].tolist() == list(OWN.kp_nm_rad)
    assert view_of_signature(signature).setup.settings == PropSettings(**keywords)
    for name, value, words in (
        ("prop", {"name": "box", "mjcf": "<"}, "keyword prop .*MJCF"),
        ("prop", {"radius": 1}, "keyword prop .*'radius'"),
        ("pairs", [[{"radius_m": 1.0}, 1]], "keyword pairs "),
        ("named", {"a": {"from_m": 3}}, "keyword named "),
        ("gains", {"kp_nm_rad": [1.0] * 6, "kv_nms_rad": [0.0] * 6}, "keyword gains .* must be 0.01 to"),
    ):
        with pytest.raises(RecordingError, match=words):
            keywords_of(replace(run.header, kwargs={name: value}))
        with pytest.raises(CheckpointError, match="its kwargs make no environment"):
            view_of_signature(replace(signature, kwargs={name: value}))


@pytest.mark.parametrize("slow", [0.25, 0.5])
def test_a_run_that_was_slowed_down_is_replayed_without_another_lag(tmp_path: Path, slow: float) -> None:
    full = record(tmp_path / "full", SINE, [5], 100)
    cell = CellConfig(speed_factor=slow)
    slowed = record(tmp_path / "slowed", SINE, [5], 100, cell=cell)
    found = compare(full, slowed)
    # A law of 30 ms at full speed, 7.5 at a quarter: the adapter takes out what there is.
    for arm in found.arms:
        assert abs(arm.lag.value) < 2e-4
        assert arm.found.flange_m.most < 1e-4
    assert replay(slowed).is_exact


def test_an_episode_that_ends_early_says_so(tmp_path: Path) -> None:
    run = record(tmp_path / "run", SINE, [1], 10_000, duration_s=1.0)
    episode = run.episodes[0]
    again = replace(
        episode,
        action=np.concatenate([episode.action] * 2),
        targets_rad=np.concatenate([episode.targets_rad] * 2),
        q_rad=np.concatenate([episode.q_rad, episode.q_rad[1:]]),
        reward=np.concatenate([episode.reward] * 2),
    )
    found = replay(replace(run, episodes=[again]))
    assert f"ended in step {len(episode.action) - 1}, and was {2 * len(episode.action)} steps long" in found.difference
    assert found.success is not None


def test_the_recorded_policy_gives_the_actions_in_order(sine: Run) -> None:
    policy = RecordedPolicy(sine, 1)
    assert isinstance(policy, Policy)
    for _ in range(2):
        policy.reset()
        found = [policy(np.zeros(3)) for _ in range(len(policy))]
        assert (np.array(found) == sine.episodes[1].action).all()
        assert found[0].dtype == sine.episodes[1].action.dtype
        with pytest.raises(RecordingError, match=f"has {STEPS} actions, and number {STEPS} was asked for"):
            policy(np.zeros(3))
    first = sine.episodes[1].action[0].copy()
    found[0][:] = 9.0
    policy.reset()
    assert (policy(np.zeros(3)) == first).all()


def headed(run: Run, **values: Any) -> Run:
    return replace(run, header=replace(run.header, **values))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"env_id": "DualUR10/Juggling-v0"}, "this version has DualUR10/SineTracking-v0"),
        ({"family": "e-series"}, "tick of 0.008 s: expected is one of"),
        ({"family": "e-series", "tick_s": 0.002}, r"e-series controllers \(500 Hz\), the cell has cb3 \(125 Hz\)"),
        ({"tick_s": 0.002}, "'cb3' with a tick of 0.002 s"),
        ({"period_ticks": 4}, "ticks per action: 4 in the recording, 5 in the environment"),
        ({"kwargs": {"policy_rate_hz": 12.5}}, "ticks per action: 5 in the recording, 10 in the environment"),
        ({"kwargs": {"cell": {"family": "cb3"}}}, "the cell of the recording is not legal: .*'family'"),
        ({"kwargs": {"cell": {"servoj": {"gain": 9e9}}}}, "is not legal: servoj gain"),
        ({"kwargs": {"cell": {"obstacles": [{"radius": 1}]}}}, "is not legal: .*'radius': use those of Box"),
        *(
            ({"kwargs": {"cell": each}}, "a simulated run's is not a file")
            for each in ("lab.toml", "/a/lab.toml", "./x/y")
        ),
        *(({"kwargs": each}, r"cannot be made|not legal") for each in ({"cameras": [[1]]}, {"id": "x"})),
        ({"env_id": ENV_IDS[2]}, "numbers of an action: 12 in the recording, 14"),
        ({"speed_factor": 0.0}, "speed_factor of the recording is 0.0"),
        ({"speed_factor": 1.5}, "speed_factor of the recording is 1.5"),
        (
            {"mounts": [{"position_m": [-0.75, y, 0.3], "yaw_rad": 0.0, "dh": DH} for y in (0.6, -0.6)]},
            "left: the base was",
        ),
        (
            {"mounts": [{"position_m": [-0.75, y, 0.0], "yaw_rad": 0.2, "dh": DH} for y in (0.6, -0.6)]},
            "turned by 0.2 rad",
        ),
        (
            {
                "mounts": [
                    {"position_m": [-0.75, y, 0.0], "yaw_rad": 0.0, "tilt_rad": [0.08, 0.08], "dh": DH}
                    for y in (0.6, -0.6)
                ]
            },
            "tilted by 0.113137 rad",
        ),
        ({"mounts": [{"position_m": [0, 0, 0], "yaw_rad": 0.0, "dh": {**DH, "d_m": [0.0] * 6}}] * 2}, "another robot"),
        (
            {"mounts": [{"position_m": [-0.75, y, 0.0], "robot": "ur5"} for y in (0.6, -0.6)]},
            "left arm is a 'ur5', that of the cell a 'ur10'",
        ),
    ],
)
def test_what_does_not_fit_is_refused(sine: Run, values: dict[str, Any], words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        replay(headed(sine, **values))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"action": np.zeros((0, 12))}, "has no action"),
        ({"action": np.full((STEPS, 12), np.nan)}, "action 0 of episode 0 is not finite"),
        ({"action": np.zeros((STEPS, 14))}, "numbers of an action: 14 in the recording, 12"),
        ({"q_rad": np.zeros((STEPS, 2, 6))}, "joints of an episode"),
        ({"targets_rad": np.zeros((STEPS, 4, 2, 6))}, "targets of an episode"),
        ({"q_rad": np.zeros((STEPS + 1, 2, 6))}, "began elsewhere"),
    ],
)
def test_damaged_episodes_are_refused(sine: Run, change: dict[str, Any], words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        replay(replace(sine, episodes=[replace(sine.episodes[0], **change)]))


@pytest.mark.parametrize("number", [-1, 3])
def test_an_episode_that_is_not_there_is_refused(sine: Run, number: int) -> None:
    with pytest.raises(RecordingError, match=f"there is no episode {number}"):
        replay(sine, episode=number)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", json.dumps({"bit_generator": "PCG64", "state": {"state": -1}}), "9" * 99]
)
def test_a_damaged_generator_is_refused(sine: Run, text: str) -> None:
    events = [replace(each, text=text) if each.kind == "generator" else each for each in sine.events]
    with pytest.raises(RecordingError, match="the generator of episode 0 cannot be read"):
        replay(replace(sine, events=events))


def test_a_cell_is_refused_before_anything_is_made(sine: Run, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    text = (
        "kind = 'emulated'\n[left]\nhost='127.0.0.2'\nfamily='e-series'\n[right]\nhost='127.0.0.3'\nfamily='e-series'\n"
    )
    path.write_text(text)
    with pytest.raises(RecordingError, match="the cell has e-series"):
        replay(sine, path)


def test_an_episode_without_its_beginning_is_not_replayed(sine: Run) -> None:
    within = replace(
        sine, episodes=[replace(sine.episodes[0], first_step=3), *sine.episodes[1:]], events=sine.events[1:]
    )
    with pytest.raises(RecordingError, match="begins with its step 3, as in a black box"):
        replay(within)
    texts = [each.text for each in sine.events if each.kind == "generator"]
    assert len(texts) == len(sine.episodes)
    events = [each for each in sine.events if each.text != texts[0]]
    assert replay(replace(within, events=events), episode=2).is_exact  # by its own generator
    assert replay(replace(within, events=events), episode=1).is_exact


def test_keywords_of_simulation_are_not_passed_to_controllers(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text("kind = 'emulated'\n[left]\nhost='127.0.0.2'\n[right]\nhost='127.0.0.3'\n")
    head = header(
        kwargs={"randomization": "mild", "observation": "pixels", "cell": {}, "amplitude_m": 0.05, "width": 9}
    )
    assert keywords_of(head, path) == {"cell": path, "amplitude_m": 0.05, "action_latency_ticks": 5}
    assert keywords_of(replace(head, latency_ticks=9), path)["action_latency_ticks"] == 9
    assert keywords_of(head)["cell"] == CellConfig()
    assert keywords_of(head)["randomization"] == "mild"
    check_replayable(head, keywords_of(head)["cell"])
    assert keywords_of(replace(head, latency_ticks=5, source="emulated"))["action_latency_ticks"] == 5


def test_flanges_by_a_recordings_mounts_are_where_they_were(tmp_path: Path) -> None:
    cell = CellConfig(left=ArmMount((-0.76, 0.61, 0.0), 0.3), right=ArmMount((-0.75, -0.6, 0.05), -0.2))
    run = record(tmp_path / "run", SINE, [5], 10, cell=cell)
    episode = run.episodes[0]
    for arm, mount in enumerate(mounts_of(run.header)):
        assert mount == (cell.left, cell.right)[arm]
        assert flange_of(mount, episode.q_rad[:, arm])[0] == pytest.approx(episode.flange_m[:, arm], abs=1e-6)


def test_a_simulated_run_can_be_compared_and_fitted(tmp_path: Path) -> None:
    a = record(tmp_path / "a", SINE, [5], 100)
    b = record(tmp_path / "b", SINE, [5], 100, cell=CellConfig(perturbation=TYPICAL_PERTURBATION))
    found = compare(a, b)
    assert found.arms[0].sent.compared == 500
    assert found.timing[0].arms[0].late.late == (0, 0)
    assert found.timing[0].skew_s.most == 0.0
    for arm, own in enumerate(fit(b)):
        # The typical perturbation: lookahead +5 %, and 2 ms of latency.
        assert own.law.lookahead_s == pytest.approx(0.0315, abs=1e-6)
        assert own.law.latency_s == pytest.approx(0.002, abs=1e-6)
        assert fit(a)[arm].arm.latency_s == pytest.approx(0.0, abs=1e-5)
