"""Settings of trainings, general ones and those of this package's tasks. The shipped policies were made with them."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, get_args

from pydantic import Discriminator, Field, Tag

from dual_ur10.envs.api.two_agents import RewardKind
from dual_ur10.envs.core.options import split_keywords
from dual_ur10.envs.tasks.goal_fields import GOAL_FIELDS
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.ids import TASKS, env_id_of
from dual_ur10.policies.chunks.chunk_policy import MOST_ACTIONS, ChunkMode
from dual_ur10.policies.learned import schema
from dual_ur10.policies.learned.manifest import AgentsKind
from dual_ur10.policies.learned.network import MOST_LAYERS, MOST_WIDTH, Activation
from dual_ur10.policies.learned.schema import StrictJson
from dual_ur10.policies.learned.signature import view_of
from dual_ur10.policies.operators.catalog import device_class
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.named_cell import resolve_cell
from dual_ur10.sim2real.recording.header import built
from ur_core.objects import load_object

Algorithm = Literal["ppo", "sac", "bc", "dagger", "act"]
IMITATION: Final = ("bc", "dagger", "act")
"""Algorithms that learn from the scripted policy or from a dataset."""

LATENCY_TICKS: Final = 5
"""Action latency of imitation: 40 ms, the default of an environment on two controllers."""

IMAGE_SIZE: Final = {"width": 224, "height": 224}
"""Size of the images of a training, unless it is stated: that for which ResNet18 was made."""

WITH_IMAGES: Final = {
    "dim_model": 512,
    "dim_feedforward": 3200,
    "n_encoder_layers": 4,
    "batch_size": 32,
    "learning_rate": 1e-4,
    "fit_steps": 100_000,
    "check_steps": 20_000,
}
"""Settings of ACT on images: LeRobot's sizes, which need a GPU."""

CHECK_SEED: Final = 10_000_000
"""First seed of the episodes that check a training's progress. Published figures begin at 0."""

_ENVS, _CHECKS = 64, 32
_STEPS: Final = {"ppo": 1_000_000, "sac": 300_000, "bc": 96_000, "dagger": 288_000}
"""Steps of trainings of tasks that do not state them."""

_CORRECTED_STEPS: Final = 15_000  # ten minutes of a person, at 25 Hz

_FIRST_SEED, _SEEDS_EACH, _MOST_SEED = 1_000_000_000, 1_000_000, 2_000_000

Count = Annotated[int, Field(ge=1, le=10**9)]
Samples = Annotated[int, Field(ge=2, le=10**7)]
Ratio = Annotated[float, Field(ge=0.0, le=1.0)]
ActionSize = Annotated[float, Field(ge=0.0, le=2.0)]
LearningRate = Annotated[float, Field(ge=1e-12, le=1.0)]
Positive = Annotated[float, Field(ge=1e-12, le=10.0)]
Units = Annotated[tuple[Annotated[int, Field(ge=1, le=4096)], ...], Field(min_length=1, max_length=7)]


@dataclass(frozen=True, kw_only=True)
class Reinforcement(StrictJson):
    """Settings of PPO and SAC; names are those of Stable-Baselines3 unless stated.

    Attributes:
        hidden: Units of each hidden layer.
        learning_rate: Learning rate of Adam at the beginning. It decays linearly to 0.
        gamma: Discount of rewards per step.
        episode_steps: Steps after which an episode of the training is truncated; None: only the task ends it. Short
            episodes return an untrained policy to the reference before it has drifted far. The first ones end at
            random times, so that cells do not keep step. Checks use whole episodes.
        steps_per_update: PPO: steps of each cell between two updates.
        batch_size: Samples of a gradient step.
        epochs: PPO: passes over the samples of an update.
        gae_lambda: PPO: parameter of the advantage estimate.
        clip_range: PPO: clipping range of the probability ratio.
        entropy: PPO: weight of the entropy.
        first_std: Initial standard deviation of actions.
        last_std: Standard deviation of actions in the last tenth of the training. It decays exponentially until then:
            exploration then is as wide as the error that is left. PPO does not learn it; SAC aims at its entropy.
        gripper_std: Ratio of the standard deviation of a gripper's action to those of the others. Tools must be
            right within millimetres, and fingers move by centimetres before anything changes.
        critic_first: PPO: ratio of the training in which only the value function learns. A policy that can do
            something already is not spoiled by the advantages of a value function that knows nothing yet.
        target_kl: PPO: an update ends early once the policy has moved 1.5 times as far; None: it never does.
        buffer_size: SAC: capacity of the replay buffer, in transitions.
        learning_starts: SAC: transitions before the first gradient step.
        gradient_steps: SAC: gradient steps after each step of all cells.
        unseen: As `Imitation.unseen`. With fewer values a policy is found in fewer steps. Value functions see them
            nevertheless (L. Pinto et al., "Asymmetric Actor Critic for Image-Based Robot Learning", RSS 2018): to act,
            an arm needs the way to its goal alone, but what it will earn depends on the phase of the task.
        reward: Reward of each arm's row, unless one network acts for both ("joint"): that of both arms, or its own.
        differences: Learn from the change of the reward at each step instead of the reward; see
            `dual_ur10.envs.api.sb3_bridge.RewardDifferences`. What a single action has changed is then not hidden
            under what earlier ones have earned.
        refusals: With differences: ratio of the reward's term of refused motions that counts at the end of the
            training. It grows linearly from 0; with 1, they count as in the task at the end.
        scaled: Scale what a policy observes by its running mean and deviation. Fields that are made for learners are
            better left alone: a deviation of early training is small where the arms have hardly been. What only value
            functions see is always scaled.
    """

    hidden: Units = (256, 256)
    learning_rate: LearningRate = 3e-4
    gamma: Ratio = 0.99
    episode_steps: Count | None = None
    steps_per_update: Count = 64
    batch_size: Samples = 1024
    epochs: Count = 5
    gae_lambda: Ratio = 0.95
    clip_range: Positive = 0.2
    entropy: Annotated[float, Field(ge=0.0, le=1e6)] = 0.0
    first_std: Positive = 0.3
    last_std: Positive = 0.1
    gripper_std: Positive = 1.0
    critic_first: Ratio = 0.0
    target_kl: Positive | None = None
    buffer_size: Count = 300_000
    learning_starts: Annotated[int, Field(ge=0, le=10**9)] = 5_000
    gradient_steps: Count = 8
    unseen: tuple[str, ...] = ()
    reward: RewardKind = "shared"
    differences: bool = False
    refusals: Ratio = 0.0
    scaled: bool = True


@dataclass(frozen=True, kw_only=True)
class Demonstrated(StrictJson):
    """Settings of all that learns from episodes of the expert, or of a dataset.

    Attributes:
        learning_rate: Learning rate of Adam at the beginning of each fit; it decays along a half cosine.
        batch_size: Samples of a gradient step.
        fit_steps: Gradient steps of each fit.
        noise: Largest standard deviation of the noise on the expert's actions, in their units. It shows how the expert
            recovers. Each episode samples its own.
        demonstrations: Number of the expert's episodes, but for DAgger; 0: as many as the steps hold.
        unseen: Fields of an arm's observation (`ObservationLayout`) that the network does not see. An effect of an
            action, such as the speed that it led to, is easier to learn from than its cause, and fails when the network
            drives (P. de Haan et al., "Causal Confusion in Imitation Learning", NeurIPS 2019).
    """

    learning_rate: LearningRate = 4e-3
    batch_size: Samples = 1024
    fit_steps: Count = 8000
    noise: ActionSize = 0.1
    demonstrations: Annotated[int, Field(ge=0, le=10**6)] = 0
    unseen: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ActSettings(Demonstrated):
    """Settings of ACT, beside those of `Demonstrated`; names of sizes are those of LeRobot.

    Attributes:
        chunk_size: Number of actions in a chunk.
        dim_model: Size of a token.
        n_heads: Number of heads of the attention.
        dim_feedforward: Units of the hidden layer behind an attention.
        n_encoder_layers: Number of layers of the encoder. The decoder has one.
        check_steps: Gradient steps between two progress checks.
        averaging: Ratio of the mean weights that a gradient step keeps. The mean is what is checked and saved.
        chunk_mode: Meaning of a chunk's actions; see `dual_ur10.policies.chunks.chunk_policy.ChunkPolicy`.
        demonstrated: Action mode of the demonstrations, of the expert's or of a dataset; "": that of the environment.
            A chunk is of joints in any case.
        backbone: With images: file of safetensors with the initial weights of ResNet18 by torchvision's names; "":
            random ones.
    """

    learning_rate: LearningRate = 7e-4
    batch_size: Samples = 64
    fit_steps: Count = 12_000
    demonstrations: Annotated[int, Field(ge=0, le=10**6)] = 50
    chunk_size: Annotated[int, Field(ge=1, le=MOST_ACTIONS)] = 12
    dim_model: Annotated[int, Field(ge=1, le=MOST_WIDTH)] = 128
    n_heads: Annotated[int, Field(ge=1, le=MOST_WIDTH)] = 8
    dim_feedforward: Annotated[int, Field(ge=1, le=MOST_WIDTH)] = 256
    n_encoder_layers: Annotated[int, Field(ge=1, le=MOST_LAYERS)] = 2
    check_steps: Count = 6000
    averaging: Ratio = 0.998
    chunk_mode: ChunkMode = "joint_delta"
    demonstrated: Literal["", "joint_delta", "joint_position", "tcp_delta"] = ""
    backbone: Annotated[str, Field(max_length=1000)] = ""


@dataclass(frozen=True, kw_only=True)
class Imitation(Demonstrated):
    """Settings of behaviour cloning and of DAgger, beside those of `Demonstrated`.

    Attributes:
        hidden: Units of each hidden layer.
        activation: Activation of the hidden layers.
        expert_share: DAgger: ratio of episodes that the expert begins and hands over somewhere. It decays to 0 until
            three quarters of the steps are done. In the first round the expert drives all episodes to their end.
        scatter_rad: Largest standard deviation, in rad, by which a fit displaces the commanded joints of its samples.
            See `dual_ur10.policies.training.regression.Scatter`. It replaces what few demonstrations do not show.
        patience: DAgger: largest difference of any joint's action from the expert's, of 2, at which the network keeps
            driving. Beyond it the expert drives for a while.
        corrected: DAgger with an operator: episodes that the person keeps between two fits.
    """

    hidden: Units = (256, 256)
    activation: Activation = "tanh"
    expert_share: Ratio = 0.5
    scatter_rad: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    patience: ActionSize = 0.4
    corrected: Count = 5


@dataclass(frozen=True, kw_only=True)
class TaskSettings:
    """Settings of one task.

    Attributes:
        envs: Number of cells that imitation steps together. PPO and SAC step as many as the default.
        steps: Total number of environment steps, by algorithm; general numbers for those that are left out.
        randomization: Variation from episode to episode.
        keywords: Further keywords of the environment.
        from_scratch: Keywords of PPO and SAC instead of these and the default latency. Without random plants and
            latency an untrained policy learns in a third of the steps.
        agents: Networks of PPO and SAC from scratch, unless others are asked for; imitation: "joint".
        ppo: Settings of PPO from scratch. With a checkpoint to begin with, the general ones count.
        sac: Settings of SAC.
        imitation: Settings of bc and dagger.
        act: Settings of act, whose `unseen` hold, if there are any, instead of those of `imitation`.
        joint_unseen: Fields that one network for both arms does not see either in imitation. A goal that the expert
            does not follow is no help, and what its own motion has led to misleads it.
        checks: Number of episodes of each progress check of imitation. For PPO and SAC it is the default.
    """

    envs: int = _ENVS
    steps: dict[str, int] = dataclasses.field(default_factory=dict)
    randomization: str = "mild"
    keywords: dict[str, Any] = dataclasses.field(default_factory=dict)
    from_scratch: dict[str, Any] = dataclasses.field(
        default_factory=lambda: {"randomization": "none", "action_latency_ticks": 0}
    )
    agents: AgentsKind = "joint"
    ppo: Reinforcement = Reinforcement()
    sac: Reinforcement = Reinforcement()
    imitation: Imitation = Imitation()
    act: ActSettings = ActSettings()
    joint_unseen: tuple[str, ...] = ()
    checks: int = _CHECKS


_ARM_MOTION: Final = ("q_rad", "qd_rad_s", "flange_base_m", "flange_base_quat", "force_n", "torque_nm")
_MOTION_FIELDS: Final = (*_ARM_MOTION, "other_flange_m", "other_flange_quat")
_SINE_UNSEEN: Final = (
    "q_rad",
    "qd_rad_s",
    "flange_base_m",
    "flange_base_quat",
    "reference_base_m",
    "ahead_base_m",
    "rotation",
)
_OTHER_FLANGE: Final = ("other_flange_base_m", "other_flange_base_quat")
_GOALS: Final = tuple(field.name for field in GOAL_FIELDS)
_CARRY_UNSEEN: Final = (
    *_MOTION_FIELDS,
    "gripper_m",
    "bar_base_m",
    "bar_base_quat",
    "reference_base_m",
    "reference_base_quat",
)
_CARRY_ARM: Final = (
    *_CARRY_UNSEEN,
    "commanded_q_rad",
    "ahead_base_m",
    "ahead_base_quat",
    "time_to_path_s",
    "progress",
)

_HANDOVER_UNSEEN: Final = (
    *_MOTION_FIELDS,
    "commanded_q_rad",
    "gripper_m",
    "other_gripper_m",
    "block_base_m",
    "block_base_quat",
    "target_base_m",
    "target_base_quat",
    "role",
    "progress",
)


def _without_commanded(unseen: tuple[str, ...]) -> tuple[str, ...]:
    """Return fields that are unseen, without commanded joints and fingers, on which a chunk of joints depends."""
    return tuple(name for name in unseen if name not in ("commanded_q_rad", "gripper_m"))


# One network for each arm, which sees the step of its tool to its goal, and the fingers.
_TO_GOALS: Final = Reinforcement(
    hidden=(128, 128),
    gamma=0.95,
    steps_per_update=32,
    gae_lambda=0.9,
    first_std=0.2,
    gripper_std=2.0,
    target_kl=0.02,
    reward="individual",
    differences=True,
    scaled=False,
)

SINE_TRACKING: Final = TaskSettings(
    keywords={"random_path": True},
    agents="shared",
    ppo=Reinforcement(
        hidden=(64, 64),
        learning_rate=1e-3,
        gamma=0.9,
        episode_steps=100,
        steps_per_update=16,
        batch_size=256,
        gae_lambda=0.9,
        first_std=0.1,
        last_std=0.006,
        unseen=(*_SINE_UNSEEN, *_OTHER_FLANGE),
        reward="individual",
    ),
    sac=Reinforcement(
        hidden=(256, 256),
        learning_rate=1e-3,
        gamma=0.9,
        episode_steps=100,
        batch_size=256,
        first_std=0.1,
        last_std=0.006,
        gradient_steps=16,
        unseen=(*_SINE_UNSEEN, *_OTHER_FLANGE),
        reward="individual",
    ),
    # It sees the commanded positions, and the step from there to the reference, which is all that the action needs.
    imitation=Imitation(unseen=_SINE_UNSEEN),
    joint_unseen=_OTHER_FLANGE,
)

SYNC_CARRY: Final = TaskSettings(
    steps={"ppo": 1_000_000, "sac": 200_000, "bc": 57_600, "dagger": 230_400},
    # It sees the commanded positions, the goal of the bar and the time. The fingers close by time alone: a network
    # that saw them kept closing after an accidental early start.
    imitation=Imitation(noise=0.05, unseen=_CARRY_UNSEEN),
    joint_unseen=_GOALS,
    from_scratch={"action_mode": "tcp_delta", "randomization": "none", "action_latency_ticks": 0},
    agents="shared",
    ppo=dataclasses.replace(
        _TO_GOALS,
        learning_rate=1e-3,
        gamma=0.9,
        episode_steps=900,
        batch_size=1024,
        last_std=0.02,
        refusals=1.0,
        unseen=_CARRY_ARM,
    ),
)

HANDOVER: Final = TaskSettings(
    envs=192,
    randomization="wide",
    steps={"ppo": 1_500_000, "sac": 300_000, "bc": 115_200, "dagger": 460_800},
    from_scratch={"action_mode": "tcp_delta", "randomization": "none", "action_latency_ticks": 0},
    agents="shared",
    ppo=dataclasses.replace(
        _TO_GOALS, episode_steps=500, batch_size=4096, epochs=10, last_std=0.05, unseen=_HANDOVER_UNSEEN
    ),
    # It sees the commanded positions, the fingers, the block, its goal and the role.
    imitation=Imitation(unseen=(*_MOTION_FIELDS, "progress")),
    act=ActSettings(demonstrated="tcp_delta", noise=0.2, unseen=_without_commanded(_HANDOVER_UNSEEN)),
    joint_unseen=_GOALS,
    # Rounds differ by a few percent, which 32 episodes do not tell.
    checks=128,
)


def _led(props: tuple[str, ...], *further: str) -> TaskSettings:
    """Return the settings of a task whose goals lead through all stages; the network sees these goals alone.

    With steps of the tools the scripted policy follows them. Labels of a script that runs by time, as with steps of the
    joints, contradict each other along its path, and nothing was learned from them.
    """
    arm = (*_ARM_MOTION, "commanded_q_rad", "gripper_m")
    poses = [f"{name}_base_{unit}" for name in props for unit in ("m", "quat")]
    return TaskSettings(
        envs=96,
        steps={"ppo": 1_500_000, "sac": 300_000, "bc": 96_000, "dagger": 144_000},
        keywords={"action_mode": "tcp_delta"},
        from_scratch={"action_mode": "tcp_delta", "randomization": "none", "action_latency_ticks": 0},
        agents="shared",
        ppo=dataclasses.replace(
            _TO_GOALS, episode_steps=500, batch_size=4096, epochs=10, last_std=0.05, unseen=(*arm, *poses, *further)
        ),
        imitation=Imitation(fit_steps=4000, unseen=(*arm, *poses, *further)),
        act=ActSettings(demonstrated="tcp_delta", unseen=_without_commanded((*arm, *poses, *further))),
        checks=96,
    )


PEG_INSERTION: Final = _led(("peg", "plate"))
TRAY_BALANCE: Final = _led(("tray", "ball", "goal"), "ball_base_m_s")
LID_AND_PLACE: Final = _led(("case", "block"), "lid_rad")


def task_settings(env_id: str) -> TaskSettings:
    """Return the settings that a task brings, or general ones.

    Args:
        env_id: Full id of the environment.

    Raises:
        SettingsError: It is registered with something else.
    """
    found = TASKS[env_id].training
    if isinstance(found, str):
        found = load_object(found, f"the settings of trainings of {env_id}", registered=True)
    if found is None:
        return TaskSettings()
    if not isinstance(found, TaskSettings):
        raise SettingsError(f"{env_id} is registered with training={found!r:.80}: it must be a TaskSettings")
    return found


@dataclass(frozen=True, kw_only=True)
class Training(StrictJson):
    """Specification of one training, kept in its folder.

    Attributes:
        env_id: Id of the environment.
        algorithm: Learning algorithm.
        agents: "joint": one network for both arms; "shared": the same one for each arm by itself; "independent": one
            for each.
        envs: Number of cells that are stepped together.
        steps: Total number of environment steps. A training ends after the episode, or the update of PPO, in which it
            reaches them; DAgger also where they allow no further episode in a quarter of the cells.
        seed: Seed of all random numbers.
        keywords: Keywords of the environment.
        checks: Number of episodes of each progress check.
        settings: Settings of the algorithm.
        dataset: Id of a Minari dataset that bc learns from and dagger begins with; "": none.
        init: Folder of a checkpoint whose network to begin with; "": none.
        operator: Device of a person who corrects the policy in DAgger; "": the scripted policy labels.

    Raises:
        SettingsError: A value is not possible.
        UnknownNameError: No such environment, algorithm or kind of agents.
    """

    env_id: str
    algorithm: str
    agents: str
    envs: int
    steps: int
    seed: int
    keywords: dict[str, Any]
    checks: int
    settings: Annotated[
        Annotated[Reinforcement, Tag("reinforcement")]
        | Annotated[Imitation, Tag("imitation")]
        | Annotated[ActSettings, Tag("act")],
        Discriminator(
            lambda value: "act" if "dim_model" in value else "imitation" if "fit_steps" in value else "reinforcement"
        ),
    ]
    dataset: str = ""
    init: str = ""
    operator: str = ""

    @property
    def demonstrated(self) -> dict[str, Any]:
        """Keywords of the environment in which the expert acts, or a dataset was made."""
        mode = self.settings.demonstrated if isinstance(self.settings, ActSettings) else ""
        return {**self.keywords, "action_mode": mode} if mode else self.keywords

    def __post_init__(self) -> None:
        env_id_of(self.env_id)
        if isinstance(self.keywords.get("cell"), Mapping):  # as the file of a training holds it
            object.__setattr__(self, "keywords", {**self.keywords, "cell": _cell_of(self.keywords["cell"])})
        if self.algorithm not in get_args(Algorithm):
            raise UnknownNameError("algorithm", str(self.algorithm), get_args(Algorithm))
        if self.agents not in get_args(AgentsKind):
            raise UnknownNameError("agents", str(self.agents), get_args(AgentsKind))
        for name, least, most in (("envs", 1, 4096), ("steps", 1, 10**12), ("checks", 1, 10**6)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                raise SettingsError(f"{name} is {value!r}: it must be a whole number, {least} to {most}")
        first_seed_of(self.seed)
        check_simulated(
            self.keywords, "training", "train without it, then evaluate with --cell", images=self.algorithm == "act"
        )
        kinds: dict[str, type] = {"ppo": Reinforcement, "sac": Reinforcement, "act": ActSettings}
        if not isinstance(self.settings, kinds.get(self.algorithm, Imitation)):
            raise SettingsError(f"{type(self.settings).__name__} holds no settings of {self.algorithm}")
        if self.dataset and self.algorithm not in IMITATION:
            raise SettingsError(f"{self.algorithm} learns from no dataset: leave it out, or use bc, dagger or act")
        if self.operator:
            self._check_operator()
        if self.init and self.algorithm == "sac":
            raise SettingsError("sac begins with no checkpoint, its network has another form: use ppo")
        if self.algorithm == "act":
            self._check_act()
        if isinstance(self.settings, Imitation) and self.settings.activation not in get_args(Activation):
            raise UnknownNameError("activation", str(self.settings.activation), get_args(Activation))
        schema.check(self.settings, f"settings of {self.algorithm}", SettingsError)
        if isinstance(self.settings, Reinforcement) and self.settings.differences and self.settings.gamma == 1.0:
            raise SettingsError("gamma is 1, at which differences of the reward leave nothing to learn: use less")
        if isinstance(self.settings, Reinforcement) and self.algorithm == "ppo":
            rows = self.envs * self.settings.steps_per_update
            if rows < 2:
                raise SettingsError(f"envs times steps_per_update is {rows}: an update of ppo needs 2 samples or more")

    def _check_act(self) -> None:
        """Refuse what a transformer for both arms does not do."""
        if self.agents != "joint":
            raise SettingsError(f"agents is {self.agents!r}: act makes one network for both arms, 'joint'")
        if self.init:
            raise SettingsError("act begins with no checkpoint: leave it out")
        if self.dataset and self.keywords.get("observation") == "both":
            raise SettingsError("a dataset has no images, and observation is 'both': leave out one of both")

    def _check_operator(self) -> None:
        """Refuse what does not go together with a person."""
        device_class(self.operator)
        if self.algorithm != "dagger":
            remedy = "use dagger"
            if self.algorithm in IMITATION:
                remedy = f"collect --operator makes a dataset, from which {self.algorithm} learns"
            raise SettingsError(f"{self.algorithm} learns from no operator: {remedy}, or leave the operator out")
        if self.envs != 1:
            raise SettingsError(f"envs is {self.envs} with an operator: one person leads one cell, so leave it out")
        if not (self.init or self.dataset):
            raise SettingsError(
                "an operator corrects a policy, and there is none to begin with: name a checkpoint with --init, or a "
                "dataset of demonstrations with --dataset"
            )


def _cell_of(values: Mapping[str, Any]) -> CellConfig:
    """Return a cell from its values in a file.

    Raises:
        SettingsError: They make none.
    """
    try:
        cell: CellConfig = built(CellConfig, values)
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:
        raise SettingsError(f"its cell is not legal: {error!s:.200}. It is damaged, or of another version") from error
    return cell


def first_seed_of(seed: int) -> int:
    """Return the first seed of the episodes that the training with this seed learns from. It may use a million.

    No policy is judged by episodes that it learned from: checks begin at `CHECK_SEED`, published figures at 0.

    Raises:
        SettingsError: The seed is out of its range.
    """
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < _MOST_SEED:
        raise SettingsError(f"the seed of a training is {seed!r}: it must be a whole number, 0 to {_MOST_SEED - 1}")
    return _FIRST_SEED + _SEEDS_EACH * seed


def check_simulated(keywords: Mapping[str, Any], purpose: str, remedy: str, *, images: bool = False) -> None:
    """Refuse environments in which nothing can be learned or collected.

    Args:
        keywords: Keywords of the environment.
        purpose: Noun for the message, such as "training".
        remedy: Alternative for a cell of two controllers.
        images: Images may be observed beside the numbers.

    Raises:
        SettingsError: The cell is of two controllers, or the observation has other pixels.
        DualUR10Error: A keyword is not legal.
    """
    options, _ = split_keywords(dict(keywords))
    cell = resolve_cell(options.cell)
    if cell.controllers or cell.state_is_commanded:
        raise SettingsError(
            f"the cell {options.cell!s:.120} is not simulated, and {purpose} is in simulation: {remedy}"
        )
    allowed = ("state", "goals", *(("both",) if images else ()))
    if options.observation not in allowed:
        raise SettingsError(
            f"observation is {options.observation!r:.40}: {purpose} needs observation={' or '.join(map(repr, allowed))}"
        )


def defaults(
    env_id: str,
    algorithm: str = "dagger",
    agents: str | None = None,
    *,
    envs: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    randomization: object = None,
    keywords: dict[str, Any] | None = None,
    changes: dict[str, Any] | None = None,
    dataset: str = "",
    init: str = "",
    operator: str = "",
) -> Training:
    """Return a training with the default settings of its task.

    Args:
        env_id: Id of the environment, or its short name.
        algorithm: See `Training`.
        agents: See `Training`. None: `TaskSettings.agents` for PPO and SAC from scratch, "joint" otherwise.
        envs: See `Training`.
        steps: See `Training`.
        seed: See `Training`.
        randomization: As for the environment; None: that of the task's settings.
        keywords: Keywords of the environment. The default action latency is `LATENCY_TICKS`, but PPO and SAC from
            scratch have `TaskSettings.from_scratch`.
        changes: Settings of the algorithm that differ from their defaults, by name.
        dataset: See `Training`.
        init: See `Training`.
        operator: See `Training`. With one, the defaults are one cell and `_CORRECTED_STEPS`.

    Raises:
        SettingsError: A value is not possible.
        UnknownNameError: No such environment, algorithm, kind of agents, setting, keyword or device.
    """
    env_id = env_id_of(env_id)
    own = task_settings(env_id)
    if algorithm not in get_args(Algorithm):
        raise UnknownNameError("algorithm", str(algorithm), get_args(Algorithm))
    if agents is None:
        agents = "joint" if algorithm in IMITATION or init else own.agents
    settings: Reinforcement | Imitation | ActSettings = own.act if algorithm == "act" else own.imitation
    if algorithm in IMITATION:
        unseen = (*own.imitation.unseen, *(own.joint_unseen if agents == "joint" else ()))
        if algorithm == "act":
            unseen = own.act.unseen or unseen
        settings = dataclasses.replace(settings, unseen=unseen)
    asked = dict(keywords or {})
    if algorithm == "act" and asked.get("observation") == "both":
        settings, asked = dataclasses.replace(settings, **WITH_IMAGES), {**IMAGE_SIZE, **asked}  # type: ignore[arg-type]
    if algorithm not in IMITATION:
        # A checkpoint to begin with has a network of imitation's size, which is also the general one.
        settings = Reinforcement() if init else own.ppo if algorithm == "ppo" else own.sac
    names = [each.name for each in dataclasses.fields(settings)]
    for name in changes or {}:
        if name not in names:
            raise UnknownNameError(f"hyperparameter of {algorithm}", name, names)
    if randomization is not None:
        if "randomization" in asked:
            raise SettingsError("randomization is set twice: by its option and by a keyword")
        asked["randomization"] = randomization
    usual = {**own.keywords, "randomization": own.randomization, "action_latency_ticks": LATENCY_TICKS}
    if own.act.demonstrated and algorithm == "act":
        usual.pop("action_mode", None)  # it is that of the demonstrations
    given = {**(usual if algorithm in IMITATION or init else own.from_scratch), **asked}
    view_of(env_id, given)  # refuses keywords that make no environment before anything is made
    gathered = "bc" if algorithm == "act" else algorithm
    usual_envs, usual_steps = own.envs if algorithm in IMITATION else _ENVS, own.steps.get(gathered, _STEPS[gathered])
    settings = dataclasses.replace(settings, **(changes or {}))
    if isinstance(settings, ActSettings) and settings.demonstrations:
        usual_envs = min(usual_envs, settings.demonstrations)
    if operator:
        usual_envs, usual_steps = 1, _CORRECTED_STEPS
    return Training(
        env_id=env_id,
        algorithm=algorithm,
        agents=agents,
        envs=usual_envs if envs is None else envs,
        steps=usual_steps if steps is None else steps,
        seed=seed,
        keywords=given,
        checks=own.checks if algorithm in IMITATION else _CHECKS,
        settings=settings,
        dataset=dataset,
        init=os.path.abspath(init) if init else "",  # a resumed training may run elsewhere
        operator=operator,
    )
