"""Policies by name, by the path of a checkpoint, or by a class of the user's own.

Learned policies come with the package in `learned/learned_policies`, one folder for each:

    policy.safetensors, manifest.json   the checkpoint; see `dual_ur10.policies.learned.checkpoint`
    card.md, curve.png                  command, seed, time and evaluations; the learning curve
"""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym

from dual_ur10.envs.core.options import IMAGE_OPTIONS
from dual_ur10.errors import DualUR10Error, PolicyError, SettingsError, UnknownNameError
from dual_ur10.ids import LEARNED_NAMES, TASKS, env_id_of
from dual_ur10.policies.baselines import BASELINES, RandomPolicy, ZeroPolicy
from dual_ur10.policies.policy import Policy, as_policy, close_policy, policy_name
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.cell_kinds import CELL_KINDS
from ur_core.objects import load_object

if TYPE_CHECKING:
    from dual_ur10.envs.core.setup import EnvSetup

OF_INTERFACES: Final = ("max_episode_steps", "render_mode", "threads", "disable_env_checker")
"""Keywords of `gym.make` and `gym.make_vec` on which no policy depends."""

NAMES: Final = ("scripted", *LEARNED_NAMES)
"""Names that `load` accepts. Not every environment has a policy of every name."""


_ARGUMENTS: Final = (
    "task",
    "timing",
    "action_mode",
    "action_scale",
    "mounts",
    "limits",
    "settings",
    "tools",
    "grippers",
)
"""Arguments of a scripted policy, by which it knows the environment; see `ScriptedPolicy`."""

OTHERS: Final = "the path of a checkpoint, module:Class or remote:ws://HOST:PORT"
"""Further forms that `load` accepts, for messages."""


def is_path(name: object) -> bool:
    """Return True if `load` treats this as the path of a checkpoint and not as a name."""
    if not isinstance(name, str):
        return isinstance(name, os.PathLike)
    is_name = name in NAMES or is_remote(name)
    return not is_name and "\0" not in name and (os.sep in name or os.path.lexists(name))


def is_remote(name: object) -> bool:
    """Return True if `load` treats this as the address of a policy server, "remote:ws://HOST:PORT"."""
    return isinstance(name, str) and name.startswith("remote:")


def is_class(name: object) -> bool:
    """Return True if `load` treats this as a class, "package.module:Class", and not as a name or path."""
    if is_remote(name):
        return False
    return isinstance(name, str) and not is_path(name) and re.fullmatch(r"[^\W\d][\w.]*:[^\W\d]\w*", name) is not None


def check_name(name: str) -> None:
    """Check that a policy has a name that commands and evaluations accept: those of baselines, too.

    Raises:
        UnknownNameError: It has not.
    """
    if name not in (*NAMES, *BASELINES) and not (is_path(name) or is_class(name) or is_remote(name)):
        raise UnknownNameError("policy", name, (*NAMES, *BASELINES), OTHERS)


def shipped_folder(name: str, env_id: str) -> Path:
    """Return the folder of a learned policy that comes with the package.

    Raises:
        UnknownNameError: No learned policy has this name for this environment.
    """
    env_id = env_id_of(env_id)
    place = TASKS[env_id].learned.get(name)
    if place is None:
        raise _missing(name, env_id)
    package, folder = place.split(":")
    try:
        return Path(str(files(package) / folder))
    except ModuleNotFoundError as error:
        raise SettingsError(f"the policy {name!r} of {env_id} is to be in {place!r}: {error}") from error


def shipped_names(env_id: str) -> list[str]:
    """Return the names of the learned policies that come with the package for an environment."""
    return [name for name in LEARNED_NAMES if name in TASKS[env_id_of(env_id)].learned]


def scripts_of(env_id: str) -> Mapping[str, str]:
    """Return the scripted policies of an environment, by action mode, or those of the task that it derives from."""
    from dual_ur10.envs.core.setup import load_task

    env_id = env_id_of(env_id)
    if TASKS[env_id].scripted:
        return TASKS[env_id].scripted
    known = {entry.task: entry.scripted for entry in TASKS.values() if entry.scripted}
    paths = [f"{each.__module__}:{each.__qualname__}" for each in load_task(env_id).__mro__[1:]]
    return next((known[path] for path in paths if path in known), {})


def names_for(env_id: str) -> list[str]:
    """Return those of `NAMES` that `load` accepts for an environment."""
    return [*(["scripted"] if scripts_of(env_id) else []), *shipped_names(env_id)]


def _missing(name: str, env_id: str) -> UnknownNameError:
    other = f"{' or '.join(BASELINES)} in commands, `make` and `evaluate`, or {OTHERS}"
    return UnknownNameError(f"policy of {env_id}", name, names_for(env_id), other)


def env_id_beside(policy: object, env_id: str) -> str:
    """Return the full id of an environment that stands beside a policy among the arguments of a function.

    Raises:
        UnknownNameError: There is no such environment.
        SettingsError: As for `env_id_of`; or the policy is an environment: the two are exchanged.
    """
    try:
        return env_id_of(env_id)
    except (SettingsError, UnknownNameError) as error:
        if isinstance(policy, str) and _is_environment(policy):
            raise SettingsError(
                f"{env_id!r:.80} is no environment, and the policy {policy!r} is one: exchange the two arguments"
            ) from error
        raise


def _is_environment(name: str) -> bool:
    try:
        env_id_of(name)
    except (SettingsError, UnknownNameError):
        return False
    return True


def load(name: str | os.PathLike[str], env_id: str | None = None, **keywords: Any) -> Policy:
    """Load a policy for an environment with these keywords.

    A scripted policy receives the rate and latency of actions, the mounts and speed limits of the arms, and the
    task's settings, but not the kind of cell. A checkpoint is checked against the environment.

    Args:
        name: One of `NAMES`; the path of a checkpoint's folder; or "package.module:Class", a class of your own. It is
            made with those of the arguments `timing`, `action_mode`, `action_scale`, `mounts`, `limits`, `settings`,
            `tools` and `grippers` that it takes; without an environment, with none. Or the address of a
            policy server, "remote:ws://HOST:PORT". Other text that contains a "/" or names an existing file is a path.
        env_id: Id of the environment, or its short form. None: that of the checkpoint; a name requires an id.
        **keywords: As for `gym.make`. A policy ignores those that concern neither task nor cell. Without `env_id` and
            keywords, the checkpoint's own keywords apply.

    Raises:
        UnknownNameError: The policy or the environment does not exist.
        SettingsError: A name was given without an environment, the two are exchanged, or a class cannot be imported or
            made.
        PolicyError: An object of the class is no policy.
        CheckpointError: The checkpoint cannot be read, or was made for another environment.
    """
    keywords = {key: value for key, value in keywords.items() if key not in OF_INTERFACES}
    env_id = None if env_id is None else env_id_beside(name, env_id)
    if is_remote(name):
        if env_id is None:
            raise SettingsError(f"policy {str(name)!r:.200} needs an environment: name one of {', '.join(TASKS)}")
        from dual_ur10.policies.remote.remote_policy import connect

        return connect(str(name), setup_of(env_id, keywords))
    if is_class(name):
        return _made(str(name), env_id, keywords)
    if name in LEARNED_NAMES and env_id is not None:
        name = shipped_folder(str(name), env_id)
    if is_path(name):
        return _of_checkpoint(name, env_id, keywords)
    if name not in NAMES:
        raise UnknownNameError("policy", str(name), NAMES, OTHERS)
    if env_id is None:
        raise SettingsError(
            f"policy {str(name)!r} needs an environment: name one of {', '.join(TASKS)}; only the path of a "
            "checkpoint does without"
        )
    return _scripted(env_id, keywords)


def _of_checkpoint(folder: str | os.PathLike[str], env_id: str | None, keywords: Mapping[str, Any]) -> Policy:
    """Return the policy of a checkpoint; one of chunks with its executor."""
    from dual_ur10.policies.learned import checkpoint
    from dual_ur10.policies.learned.signature import view_of_signature

    policy = checkpoint.load(folder, env_id, **keywords)
    made = policy.manifest.signature

    def setup() -> EnvSetup:
        own = env_id is None and not keywords
        return view_of_signature(made).setup if own else setup_of(made.env_id, keywords)

    found: Policy = executed(policy, setup)
    return found


@contextmanager
def wrong_types_named(env_id: str) -> Iterator[None]:
    """Name the environment in a `TypeError` of the block, which a value of a keyword causes.

    Raises:
        SettingsError: There was one.
    """
    try:
        yield
    except UnknownNameError:
        raise
    except TypeError as error:
        # Gymnasium appends its location and all keywords.
        reason = str(error).split(" was raised from the environment creator")[0]
        raise SettingsError(f"a keyword of {env_id} has the wrong type: {reason}") from error


def load_named(policy: Policy | str | os.PathLike[str], env_id: str, keywords: Mapping[str, Any]) -> Policy | None:
    """Load a policy that is given by its name or folder. Return None for an object, and for a baseline.

    Args:
        policy: As for `evaluate`.
        env_id: Id of the environment.
        keywords: Keywords of the environment.

    Raises:
        UnknownNameError: No such policy.
        SettingsError: A class of one's own cannot be imported or made.
        CheckpointError: The checkpoint cannot be read, or was made for another environment.
    """
    if not isinstance(policy, str | os.PathLike) or policy in BASELINES:
        return None
    with wrong_types_named(env_id):
        return load(policy, env_id, **keywords)


def _made(path: str, env_id: str | None, keywords: Mapping[str, Any], *, registered: bool = False) -> Policy:
    """Return a policy of the class "module:Class", made with those arguments of `_ARGUMENTS` that it takes.

    Args:
        path: Module and name of the class.
        env_id: Id of the environment that the arguments are of; None: there are none.
        keywords: Keywords of the environment.
        registered: As for `load_object`.

    Raises:
        SettingsError: The class cannot be imported or made.
        PolicyError: It makes no policy.
        DualUR10Error: A keyword is not legal.
    """
    factory = load_object(path, "the policy", registered=registered)
    try:
        taken = [name for name in inspect.signature(factory).parameters if name in _ARGUMENTS]
        policy = factory(**(_arguments(env_id, keywords, taken) if taken and env_id is not None else {}))
    except DualUR10Error:
        raise
    except (TypeError, ValueError) as error:
        raise SettingsError(
            f"policy {path!r} cannot be made: {error}. Name a class whose arguments are optional, or, for an "
            f"environment, among {', '.join(_ARGUMENTS)}"
        ) from error
    if env_id is not None:
        policy = executed(policy, lambda: setup_of(env_id, keywords))
    if not isinstance(policy, Policy):
        raise PolicyError(f"{path!r} is no policy: it must have `reset()` and `__call__(observation)`")
    return policy


def executed(policy: object, setup: Callable[[], EnvSetup]) -> Any:
    """Return the executor of a chunk policy, and anything else unchanged.

    Args:
        policy: As for `make`.
        setup: Function that returns the environment.

    Raises:
        SettingsError: A chunk policy cannot be executed in the environment.
    """
    from dual_ur10.policies.chunks.chunk_policy import ChunkPolicy

    if isinstance(policy, Policy | type) or not isinstance(policy, ChunkPolicy):
        return policy
    from dual_ur10.policies.chunks.executor import executor_for

    return executor_for(policy, setup())


def setup_of(env_id: str, keywords: Mapping[str, Any]) -> EnvSetup:
    """Return an environment with these keywords, and ignore those that concern neither task nor cell."""
    from dual_ur10.envs.core.setup import EnvSetup

    return EnvSetup.resolve(env_id, keywords, ignore_unknown=True)


def _arguments(env_id: str, keywords: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    return arguments_of(setup_of(env_id, keywords), names)


def arguments_of(setup: EnvSetup, names: Collection[str]) -> dict[str, Any]:
    """Return those arguments of a policy, out of `_ARGUMENTS`, that are named, for an environment."""
    values = {
        "task": setup.task_type,
        "timing": setup.timing,
        "action_mode": setup.options.action_mode,
        "action_scale": setup.options.action_scale,
        "mounts": (setup.config.left, setup.config.right),
        "limits": setup.step_limits,
        "settings": setup.settings,
        "tools": setup.config.equipment.tools,
        "grippers": setup.config.equipment.grippers and not setup.config.equipment.welded,
    }
    return {name: values[name] for name in names}


def _scripted(env_id: str, keywords: Mapping[str, Any]) -> Policy:
    from dual_ur10.envs.core.options import EnvOptions

    classes = scripts_of(env_id)
    if (observation := keywords.get("observation", "state")) != "state":
        raise SettingsError(
            f"observation is {observation!r:.40}, and scripted policies read all fields of the task and no image: use "
            "observation='state'. A record has the images of all cameras of the cell file all the same"
        )
    mode = str(keywords.get("action_mode", EnvOptions.action_mode))
    path = classes.get(mode) or classes.get("")
    if path is None and classes:
        raise SettingsError(f"the scripted policy of {env_id} is for {' and '.join(classes)}, not for {mode!r:.40}")
    if path is None:
        raise _missing("scripted", env_id)
    return _made(path, env_id, keywords, registered=True)


_INTERFACE: Final = (
    "policy_rate_hz",
    "action_mode",
    "action_scale",
    "action_latency_ticks",
    "compensate_lag",
    "observation",
    *IMAGE_OPTIONS,
)
"""Keywords of an environment that decide what a policy observes and what its actions mean."""


def keywords_for(policy: object, env_id: str, keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keywords of an environment, with those that a learned policy needs to act in it.

    These are the rate, mode, scale and latency of actions, the view of the observation and the model of the arms. One
    that is stated remains as it is, and a cell's own arms and latency remain, too. No other policy adds any.

    Args:
        policy: A policy, a chunk policy, a name, or the folder of a checkpoint.
        env_id: Id of the environment.
        keywords: Keywords of the environment.

    Raises:
        UnknownNameError: No learned policy for this environment.
        CheckpointError: The checkpoint cannot be read, or has changed since it was saved.
    """
    from dual_ur10.policies.learned.checkpoint import manifest_of, read_manifest

    if isinstance(policy, str | os.PathLike):
        folder = shipped_folder(str(policy), env_id) if policy in LEARNED_NAMES else policy
        manifest = read_manifest(folder) if is_path(folder) else None
    else:
        manifest = manifest_of(policy)
    if manifest is None:
        return dict(keywords)
    signature = manifest.signature
    needed: dict[str, Any] = {name: signature.kwargs[name] for name in _INTERFACE if name in signature.kwargs}
    cell = keywords.get("cell", "mujoco")
    simulated = isinstance(cell, CellConfig) or (isinstance(cell, str) and cell in CELL_KINDS)
    kind = cell.kind if isinstance(cell, CellConfig) else cell
    if not simulated or CELL_KINDS[kind].controllers:
        needed.pop("action_latency_ticks", None)
    elif not isinstance(cell, CellConfig) and signature.robot.names != ("ur10", "ur10"):
        needed["robot"] = signature.robot.names
    return {**keywords, **{name: value for name, value in needed.items() if keywords.get(name) is None}}


def make(
    policy: Policy | Callable[[Any], Any] | str | os.PathLike[str], env_id: str, *, seed: int = 0, **keywords: Any
) -> tuple[gym.Env[Any, Any], Policy]:
    """Return an environment and a policy that fit each other.

        env, policy = make("learned", "DualUR10/Handover-v0", render_mode="human")

    The environment has the rate, mode, scale and latency of actions, the view of the observation and the model of the
    arms for which a learned policy was made. A policy without such demands gets the environment of `gym.make`.

    Args:
        policy: As for `load`; "random" or "zero"; or a policy, a chunk policy, or a plain function from observations
            to actions.
        env_id: Id of the environment, or its short form.
        seed: Seed of random actions.
        **keywords: As for `gym.make`. They come before those of the policy, which then may not fit.

    Raises:
        UnknownNameError: The policy, the environment or a keyword does not exist.
        SettingsError: A value is not legal, policy and environment are exchanged, or a class cannot be imported or
            made.
        PolicyError: The policy is none.
        CheckpointError: The checkpoint cannot be read, or does not fit the keywords.
    """
    env_id = env_id_beside(policy, env_id)
    if isinstance(policy, str):
        check_name(policy)
    given: Any = policy
    keywords = keywords_for(given, env_id, keywords)
    if not isinstance(policy, str | os.PathLike):
        given = as_policy(executed(policy, lambda: setup_of(env_id, keywords)))
    # Before anything is connected or a folder of the run is made.
    actor = load_named(given, env_id, keywords) if isinstance(given, str | os.PathLike) else given
    try:
        with wrong_types_named(env_id):
            env = gym.make(env_id, **keywords)
    except BaseException:
        if actor is not given:
            close_policy(actor)  # a server takes one client at a time
        raise
    if policy == "random":
        return env, RandomPolicy(env.action_space, seed=seed)
    return env, ZeroPolicy(env.action_space) if actor is None else actor


def provenance(policy: Policy | str, env_id: str) -> dict[str, Any]:
    """Return a policy's name and hash for the keyword `record_about` of an environment.

    The hash is that of a checkpoint's manifest, which holds the hash of its weights. A scripted policy has none: its
    name and the version of this package, which every record holds, identify it.

    Args:
        policy: A policy, a name, or the folder of a checkpoint.
        env_id: Id of the environment.

    Raises:
        UnknownNameError: No learned policy for this environment.
        CheckpointError: The checkpoint cannot be read, or has changed since it was saved.
    """
    if not isinstance(policy, str):
        return {"policy": policy_name(policy)}
    folder = str(shipped_folder(policy, env_id)) if policy in LEARNED_NAMES else policy
    if not is_path(folder):
        return {"policy": policy}
    from dual_ur10.policies.learned.checkpoint import sha256_of

    return {"policy": policy, "policy_sha256": sha256_of(folder)}
