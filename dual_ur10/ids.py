"""Version of the package, registered tasks with what belongs to each, and shorter names of their ids."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final

from dual_ur10.errors import SettingsError, UnknownNameError
from ur_core import objects

__version__ = "0.1.0"

ENTRY_POINT_GROUP: Final = "dual_ur10.tasks"
"""Group of entry points by which an installed package brings tasks: each names a module that registers them."""

LEARNED_NAMES: Final = {
    "learned": "Learned policy with one network for both arms.",
    "learned-two-agents": "Learned policy with one network for each arm.",
}
"""Names of learned policies that a task may bring, each with what it is."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskEntry:
    """Registered task. All that it names is imported when it is needed.

    Attributes:
        task: Subclass of `dual_ur10.envs.tasks.task.Task`, "module:Class".
        scripted: Scripted policies, "module:Class", by action mode; that of "" is for every mode without its own.
        training: Settings of trainings: "module:NAME" of a `dual_ur10.policies.training.settings.TaskSettings`, such
            settings, or None for general ones.
        learned: Folders of learned policies, "package:folder", by the names of `LEARNED_NAMES`.
    """

    task: str
    scripted: Mapping[str, str] = dataclasses.field(default_factory=dict)
    training: Any = None
    learned: Mapping[str, str] = dataclasses.field(default_factory=dict)


_TASKS, _SCRIPTED, _LEARNED = "dual_ur10.envs.tasks", "dual_ur10.policies.scripted", "dual_ur10.policies.learned"
_FOLLOWER = f"{_SCRIPTED}.goal_follower:GoalFollower"
_SETTINGS = "dual_ur10.policies.training.settings"


def _entry(task: str, scripted: str, training: str, *, learned: bool = True) -> TaskEntry:
    """Return the entry of a task that is one file of `dual_ur10.tasks`, whose goals lead through all stages."""
    module = task.partition(":")[0]
    return TaskEntry(
        task=f"dual_ur10.tasks.{task}",
        scripted={
            "": f"dual_ur10.tasks.{module}:{scripted}",
            "tcp_delta": _FOLLOWER,
            "tcp_translation": _FOLLOWER,
        },
        training=f"{_SETTINGS}:{training}",
        learned={"learned": f"{_LEARNED}:learned_policies/{module}"} if learned else {},
    )


TASKS: Final = {
    "DualUR10/SineTracking-v0": TaskEntry(
        task=f"{_TASKS}.sine_tracking.task:SineTracking",
        scripted={"": f"{_SCRIPTED}.sine_tracking:SineTrackingPolicy"},
        training=f"{_SETTINGS}:SINE_TRACKING",
        learned={
            "learned": f"{_LEARNED}:learned_policies/sine_tracking",
            "learned-two-agents": f"{_LEARNED}:learned_policies/sine_tracking_two_agents",
        },
    ),
    "DualUR10/SyncCarry-v0": TaskEntry(
        task=f"{_TASKS}.sync_carry.task:SyncCarry",
        scripted={
            "": f"{_SCRIPTED}.sync_carry:SyncCarryPolicy",
            "tcp_delta": _FOLLOWER,
            "tcp_translation": _FOLLOWER,
        },
        training=f"{_SETTINGS}:SYNC_CARRY",
        learned={"learned": f"{_LEARNED}:learned_policies/sync_carry"},
    ),
    "DualUR10/Handover-v0": TaskEntry(
        task=f"{_TASKS}.handover.task:Handover",
        scripted={
            "": f"{_SCRIPTED}.handover:HandoverPolicy",
            "tcp_delta": _FOLLOWER,
            "tcp_translation": _FOLLOWER,
        },
        training=f"{_SETTINGS}:HANDOVER",
        learned={"learned": f"{_LEARNED}:learned_policies/handover"},
    ),
    "DualUR10/Free-v0": TaskEntry(task=f"{_TASKS}.free.task:Free"),
    "DualUR10/PegInsertion-v0": _entry("peg_insertion:PegInsertion", "PegScript", "PEG_INSERTION", learned=False),
    "DualUR10/TrayBalance-v0": _entry("tray_balance:TrayBalance", "TrayScript", "TRAY_BALANCE"),
    "DualUR10/BoxLift-v0": TaskEntry(
        task="dual_ur10.tasks.box_lift:BoxLift", scripted={"": "dual_ur10.tasks.box_lift:BoxScript"}
    ),
    "DualUR10/LidAndPlace-v0": _entry("lid_and_place:LidAndPlace", "LidScript", "LID_AND_PLACE"),
}
"""Tasks by id; `dual_ur10.registration.register` adds to them."""

ENV_IDS: Final = tuple(TASKS)
"""Ids of this package. An id is a promise: any change of results gets a new version."""

FAILED_ENTRY_POINTS: Final[dict[str, str]] = {}
"""Reasons for which entry points of `discover` could not be loaded, by "name = value"."""

_loaded: set[str] = set()


@contextmanager
def received(source: str) -> Iterator[None]:
    """Import and call nothing in the block that a "module:NAME" in received data names.

    Records, checkpoints and datasets may come from anybody. They name registered things, and objects that this program
    has imported already, but no functions or classes, such as those of the standard library; a cell file and a program
    may name anything.

    Args:
        source: Noun for messages, such as "the recording".
    """
    with objects.received(source, discover, ENTRY_POINT_GROUP):
        yield


def discover() -> None:
    """Load the entry points of `ENTRY_POINT_GROUP`, each once, so that the tasks of installed packages are registered.

    One that fails, or ends the program, is kept in `FAILED_ENTRY_POINTS`, and reported as a warning; the others are
    loaded nevertheless. Ctrl-C ends the program.
    """
    from importlib.metadata import entry_points  # not at import: the processes of arms do without

    log = logging.getLogger(__name__)
    for point in entry_points(group=ENTRY_POINT_GROUP):
        name = f"{point.name} = {point.value}"
        if name in _loaded:
            continue
        _loaded.add(name)
        try:
            point.load()
        except (Exception, SystemExit) as error:  # a package of others may raise anything
            FAILED_ENTRY_POINTS[name] = f"{type(error).__name__}: {error}"
            log.warning("the entry point %s of %s failed: %s", name, ENTRY_POINT_GROUP, FAILED_ENTRY_POINTS[name])
        except KeyboardInterrupt:
            log.warning("interrupted in the entry point %s of %s", name, ENTRY_POINT_GROUP)
            raise


def is_registered(env_id: str) -> bool:
    """Return True if this is the full id of a task, also of one that an installed package brings."""
    if env_id not in TASKS:
        discover()
    return env_id in TASKS


def env_id_of(name: str) -> str:
    """Return the full id of an environment, under which everything that belongs to it is kept.

    The namespace, the version or both may be left out: "Handover", "Handover-v0" and "DualUR10/Handover-v0" are the
    same. A name without a namespace means the task of this package, if it has one. A name without a version means the
    newest. As for `gym.make`, "module:id" imports the module first. A name that is none of this package's is looked up
    among those of installed packages, too.

    Raises:
        UnknownNameError: There is no such environment.
        SettingsError: It is no name, several namespaces other than that of this package have it, or the module before
            the colon cannot be imported.
    """
    if not isinstance(name, str):
        raise SettingsError(f'the environment is {name!r:.80}: pass its id, such as "Handover"')
    module, colon, name = name.rpartition(":")
    if colon:
        objects.load_module(module, f"the module {module!r}, which is to register {name!r},")
    if name in TASKS:
        return name
    fitting = [env_id for env_id in _fitting(name) if env_id in ENV_IDS]
    if not fitting and is_registered(name):
        return name
    fitting = fitting or _fitting(name)
    if not fitting:
        failed = "".join(f"; the tasks of {point} are missing, {why}" for point, why in FAILED_ENTRY_POINTS.items())
        raise UnknownNameError("environment", name, list(TASKS), f"module:id of a module that registers it{failed}")
    if len({env_id.split("/")[0] for env_id in fitting}) > 1:
        raise SettingsError(
            f"the environment {name!r} is ambiguous: it may be {' or '.join(map(repr, fitting))}. Name one with its "
            "namespace"
        )
    return max(fitting, key=lambda env_id: int(env_id.rsplit("-v", 1)[1]))


def _fitting(name: str) -> list[str]:
    """Return the ids that a shorter name may mean."""
    return [env_id for env_id in TASKS if name in _short_forms(env_id)]


def _short_forms(env_id: str) -> tuple[str, str, str]:
    versioned, unversioned = env_id.split("/")[1], env_id.rsplit("-v", 1)[0]
    return versioned, unversioned, unversioned.split("/")[1]
