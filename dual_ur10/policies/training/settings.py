"""Settings of trainings, for every task in one view. Shipped policies were made with these."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

from dual_ur10.envs.core.options import split_keywords
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.ids import env_id_of, task_name
from dual_ur10.policies.learned.manifest import AgentsKind
from dual_ur10.policies.learned.network import Activation
from dual_ur10.policies.learned.signature import view_of
from dual_ur10.policies.training import seeds
from dual_ur10.sim2real.config.cell_file import resolve_cell

Algorithm = Literal["ppo", "sac", "bc", "dagger"]

LATENCY_TICKS: Final = 5
"""Action latency of trainings: 40 ms, as an environment on two controllers has it if nothing else is said."""


@dataclass(frozen=True, kw_only=True)
class Reinforcement:
    """Settings of PPO and SAC; names and defaults as in Stable-Baselines3 where nothing is said.

    Attributes:
        hidden: Units of each hidden layer.
        learning_rate: Of Adam.
        gamma: Discount of rewards per step.
        steps_per_update: PPO: steps of each cell between two updates.
        batch_size: Samples of a gradient step.
        epochs: PPO: how often each sample is used.
        gae_lambda: PPO.
        clip_range: PPO.
        entropy: PPO: weight of the entropy.
        first_std: PPO: standard deviation of actions at the beginning.
        buffer_size: SAC: transitions kept.
        learning_starts: SAC: transitions before the first gradient step.
        gradient_steps: SAC: gradient steps after each step of all cells.
    """

    hidden: tuple[int, ...] = (256, 256)
    learning_rate: float = 3e-4
    gamma: float = 0.99
    steps_per_update: int = 64
    batch_size: int = 1024
    epochs: int = 5
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    entropy: float = 0.0
    first_std: float = 0.3
    buffer_size: int = 300_000
    learning_starts: int = 5_000
    gradient_steps: int = 8


@dataclass(frozen=True, kw_only=True)
class Imitation:
    """Settings of behaviour cloning and of DAgger.

    Attributes:
        hidden: Units of each hidden layer.
        activation: Of the hidden layers.
        learning_rate: Of Adam at the beginning of each fit; it falls along a half cosine.
        batch_size: Samples of a gradient step.
        fit_steps: Gradient steps of the fit of each round.
        expert_share: DAgger: share of the episodes that the expert begins and hands over somewhere; it falls to 0 until
            three quarters of the steps are done. In the first round it drives all to their end.
        noise: Largest standard deviation of what is added to the expert's actions where it drives, in their units:
            it then shows how it comes back. Each episode draws its own.
        patience: DAgger: largest difference of any joint's action from the expert's, of 2, at which the network drives
            on. Beyond it the expert drives for a while.
        unseen: Fields of an arm's observation (`ObservationLayout`) that the network does not see. An effect of an
            action, such as the speed that it led to, is easier to learn from than its cause, and fails when the network
            drives (P. de Haan et al., "Causal Confusion in Imitation Learning", NeurIPS 2019).
    """

    hidden: tuple[int, ...] = (256, 256)
    activation: Activation = "tanh"
    learning_rate: float = 4e-3
    batch_size: int = 1024
    fit_steps: int = 8000
    expert_share: float = 0.5
    noise: float = 0.1
    patience: float = 0.4
    unseen: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class TaskSettings:
    """Settings of one task.

    Attributes:
        envs: Cells that are stepped together.
        steps: Of the environment, in all, by algorithm.
        randomization: What differs from episode to episode.
        reinforcement: Of PPO and SAC.
        imitation: Of bc and dagger.
        checks: Episodes of each look at the progress.
    """

    envs: int = 64
    steps: dict[str, int] = dataclasses.field(default_factory=dict)
    randomization: str = "mild"
    reinforcement: Reinforcement = Reinforcement()
    imitation: Imitation = Imitation()
    checks: int = 32


_MOTION_FIELDS: Final = (
    "q_rad",
    "qd_rad_s",
    "flange_base_m",
    "flange_base_quat",
    "force_n",
    "torque_nm",
    "other_flange_m",
    "other_flange_quat",
)
_CARRY_UNSEEN: Final = (
    *_MOTION_FIELDS,
    "gripper_m",
    "bar_base_m",
    "bar_base_quat",
    "reference_base_m",
    "reference_base_quat",
)

SETTINGS: Final[dict[str, TaskSettings]] = {
    "SineTracking": TaskSettings(
        steps={"ppo": 3_000_000, "sac": 300_000, "bc": 96_000, "dagger": 288_000},
    ),
    "SyncCarry": TaskSettings(
        steps={"ppo": 1_000_000, "sac": 200_000, "bc": 57_600, "dagger": 230_400},
        # It sees what was commanded, where the bar is to go, and the time. The fingers close by time alone: where they
        # were seen, those that began early by chance went on closing.
        imitation=Imitation(noise=0.05, unseen=_CARRY_UNSEEN),
    ),
    "Handover": TaskSettings(
        envs=192,
        randomization="none",
        steps={"ppo": 3_000_000, "sac": 300_000, "bc": 115_200, "dagger": 460_800},
        # It sees what was commanded, the fingers, the block, its target and the role.
        imitation=Imitation(unseen=(*_MOTION_FIELDS, "progress")),
    ),
}


@dataclass(frozen=True, kw_only=True)
class Training:
    """What one training is asked to do. All of it is kept in its folder.

    Attributes:
        env_id: Of the environment.
        algorithm: How to learn.
        agents: "joint": one network for both arms; "shared": the same one for each arm by itself; "independent": one
            for each.
        envs: Cells that are stepped together.
        steps: Of the environment, in all.
        seed: Of everything that is drawn.
        keywords: Of the environment.
        checks: Episodes of each look at the progress.
        settings: Of the algorithm.
        dataset: Id of a Minari dataset that bc learns from and dagger begins with; "": none.
        init: Folder of a checkpoint whose network to begin with; "": none.

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
    settings: Reinforcement | Imitation
    dataset: str = ""
    init: str = ""

    def __post_init__(self) -> None:
        env_id_of(self.env_id)
        if self.algorithm not in get_args(Algorithm):
            raise UnknownNameError("algorithm", str(self.algorithm), get_args(Algorithm))
        if self.agents not in get_args(AgentsKind):
            raise UnknownNameError("agents", str(self.agents), get_args(AgentsKind))
        for name, least, most in (("envs", 1, 4096), ("steps", 1, 10**12), ("checks", 1, 10**6)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                raise SettingsError(f"{name} is {value!r}: it must be a whole number, {least} to {most}")
        seeds.episodes_of(self.seed)
        check_simulated(self.keywords, "training", "train without it, then evaluate with --cell")
        if isinstance(self.settings, Imitation) != (self.algorithm in ("bc", "dagger")):
            raise SettingsError(f"these are no settings of {self.algorithm}: {type(self.settings).__name__}")
        if self.dataset and self.algorithm not in ("bc", "dagger"):
            raise SettingsError(f"{self.algorithm} learns from no dataset: leave it out, or use bc or dagger")
        if self.init and self.algorithm == "sac":
            raise SettingsError("sac begins with no checkpoint, its network has another form: use ppo")
        check(self.settings)
        if isinstance(self.settings, Reinforcement) and self.algorithm == "ppo":
            rows = self.envs * self.settings.steps_per_update
            if rows < 2:
                raise SettingsError(f"envs times steps_per_update is {rows}: an update of ppo needs 2 samples or more")


def check_simulated(keywords: Mapping[str, Any], doing: str, remedy: str) -> None:
    """Refuse keywords of environments in which nothing is learned or collected.

    Args:
        keywords: Of the environment.
        doing: What is to be done in it.
        remedy: What to do instead of doing it on two controllers.

    Raises:
        SettingsError: It is of two controllers, or observes pixels.
        DualUR10Error: A keyword is not legal.
    """
    options, _ = split_keywords(dict(keywords))
    if resolve_cell(options.cell).kind != "mujoco":
        raise SettingsError(
            f"the cell {options.cell!s:.120} is of two controllers, and {doing} is in simulation: {remedy}"
        )
    if options.observation != "state":
        raise SettingsError(f"observation is {options.observation!r:.40}, and {doing} is of observation='state' alone")


_BOUNDS: Final[dict[str, tuple[float, float]]] = {
    "gamma": (0.0, 1.0),
    "gae_lambda": (0.0, 1.0),
    "expert_share": (0.0, 1.0),
    "entropy": (0.0, 1e6),
    "noise": (0.0, 2.0),
    "patience": (0.0, 2.0),
    "learning_rate": (1e-12, 1.0),
    "clip_range": (1e-12, 10.0),
    "first_std": (1e-12, 10.0),
    "learning_starts": (0, 10**9),
    "batch_size": (2, 10**7),
}
_COUNTS: Final = (1, 10**9)


def check(settings: Reinforcement | Imitation) -> None:
    """Refuse numbers that no algorithm can work with.

    Raises:
        SettingsError: A value is not possible.
        UnknownNameError: No such activation.
    """
    for each in dataclasses.fields(settings):
        value = getattr(settings, each.name)
        if each.name == "hidden":
            if (
                not isinstance(value, tuple)
                or not value
                or not all(type(size) is int and 1 <= size <= 4096 for size in value)
                or len(value) > 7
            ):
                raise SettingsError(f"hidden is {value!r}: it must be 1 to 7 numbers of units, 1 to 4096 each")
        elif each.name == "unseen":
            if not isinstance(value, tuple) or not all(isinstance(name, str) for name in value):
                raise SettingsError(f"unseen is {value!r}: it must be names of fields of an observation")
        elif each.name == "activation":
            if value not in get_args(Activation):
                raise UnknownNameError("activation", str(value), get_args(Activation))
        else:
            whole = isinstance(each.default, int)
            least, most = _BOUNDS.get(each.name, _COUNTS)
            kinds = (int,) if whole else (int, float)
            if type(value) not in kinds or not least <= value <= most:
                kind = "whole number" if whole else "number"
                raise SettingsError(f"{each.name} is {value!r}: it must be a {kind}, {least:g} to {most:g}")


def defaults(
    env_id: str,
    algorithm: str = "dagger",
    agents: str = "joint",
    *,
    envs: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    randomization: object = None,
    keywords: dict[str, Any] | None = None,
    changes: dict[str, Any] | None = None,
    dataset: str = "",
    init: str = "",
) -> Training:
    """A training with the settings of its task where nothing else is said.

    Args:
        env_id: Of the environment, or its short name.
        algorithm: See `Training`.
        agents: See `Training`.
        envs: See `Training`.
        steps: See `Training`.
        seed: See `Training`.
        randomization: As for the environment; None: that of the task's settings.
        keywords: Of the environment. The action's latency is `LATENCY_TICKS` if they do not name it.
        changes: Settings of the algorithm that are to be others, by name.
        dataset: See `Training`.
        init: See `Training`.

    Raises:
        SettingsError: A value is not possible.
        UnknownNameError: No such environment, algorithm, kind of agents, setting or keyword.
    """
    env_id = env_id_of(env_id)
    own = SETTINGS[task_name(env_id)]
    if algorithm not in get_args(Algorithm):
        raise UnknownNameError("algorithm", str(algorithm), get_args(Algorithm))
    settings: Reinforcement | Imitation = own.imitation if algorithm in ("bc", "dagger") else own.reinforcement
    names = [each.name for each in dataclasses.fields(settings)]
    for name in changes or {}:
        if name not in names:
            raise UnknownNameError(f"setting of {algorithm}", name, names)
    given = dict(keywords or {})
    if "randomization" in given and randomization is not None:
        raise SettingsError("randomization is set twice: by its option and by a keyword")
    given.setdefault("randomization", own.randomization if randomization is None else randomization)
    given.setdefault("action_latency_ticks", LATENCY_TICKS)
    view_of(env_id, given)  # before anything is made, for keywords that make no environment
    return Training(
        env_id=env_id,
        algorithm=algorithm,
        agents=agents,
        envs=own.envs if envs is None else envs,
        steps=own.steps[algorithm] if steps is None else steps,
        seed=seed,
        keywords=given,
        checks=own.checks,
        settings=dataclasses.replace(settings, **(changes or {})),
        dataset=dataset,
        init=os.path.abspath(init) if init else "",  # it is read again by whoever goes on, from wherever
    )
