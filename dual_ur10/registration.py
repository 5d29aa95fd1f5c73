"""Registration of the environments with Gymnasium and PettingZoo, done when `dual_ur10` is imported."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, Final, TypeVar, overload

import pettingzoo  # type: ignore[import-untyped]  # has no types
from gymnasium.envs.registration import register as register_with_gymnasium
from gymnasium.envs.registration import registry

from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.ids import LEARNED_NAMES, TASKS, TaskEntry

TaskT = TypeVar("TaskT", bound=type)

_ID: Final = re.compile(r"\w+/\w+-v(0|[1-9][0-9]*)")
_OBJECT: Final = re.compile(r"[^\W\d][\w.]*:[^\W\d]\w*")
_FOLDER: Final = re.compile(r"[^\W\d][\w.]*:[\w./-]+")


@overload
def register(
    env_id: str,
    task: None = None,
    *,
    scripted: str | type | Mapping[str, str | type] | None = None,
    training: Any = None,
    learned: Mapping[str, str] | None = None,
) -> Callable[[TaskT], TaskT]: ...


@overload
def register(
    env_id: str,
    task: str,
    *,
    scripted: str | type | Mapping[str, str | type] | None = None,
    training: Any = None,
    learned: Mapping[str, str] | None = None,
) -> None: ...


def register(
    env_id: str,
    task: str | None = None,
    *,
    scripted: str | type | Mapping[str, str | type] | None = None,
    training: Any = None,
    learned: Mapping[str, str] | None = None,
) -> Callable[[TaskT], TaskT] | None:
    """Register a task of your own with every interface: Gymnasium, its vector API, PettingZoo, and the command line.

        @register("MyLab/Reach-v0", scripted="ReachPolicy")
        class Reach(Task[ReachSettings, Array]): ...

    Import the module before `gym.make`, or write "my_package.my_module:MyLab/Reach-v0". The command line and other
    processes find it by an entry point of the group "dual_ur10.tasks" that names the module. Versions of a task are
    tasks of their own: "MyLab/Reach-v1" may have another class than "MyLab/Reach-v0" beside it, and records,
    checkpoints and policies belong to one of them.

    Args:
        env_id: New id, "Namespace/Name-vN". The namespace DualUR10 is that of this package.
        task: The subclass of `dual_ur10.envs.tasks.task.Task`, "module:Class", which is then imported on first use.
            None: a decorator of the class is returned.
        scripted: Its scripted policy: a class, "module:Class", or "Class" of the module of the task; or one of them for
            each action mode, where that of "" is for every mode without its own. It is made with the arguments
            `timing`, `action_mode`, `mounts`, `limits`, `settings`, `tools` and `grippers`, or those of them that it
            takes.
        training: Settings of its trainings: a `dual_ur10.policies.training.settings.TaskSettings`, or "module:NAME" of
            one. None: general ones.
        learned: Folders of checkpoints, "package:folder", by "learned" or "learned-two-agents".

    Raises:
        SettingsError: A value has another form, or another task has the id.
        UnknownNameError: A learned policy has another name.
    """
    if not isinstance(env_id, str) or _ID.fullmatch(env_id) is None:
        raise SettingsError(f'the id of a task is {env_id!r}: it must be "Namespace/Name-vN", such as "MyLab/Reach-v0"')
    for name in learned or {}:
        if name not in LEARNED_NAMES:
            raise UnknownNameError(f"learned policy of {env_id}", str(name), list(LEARNED_NAMES))

    def add(path: str) -> None:
        module = path.split(":")[0]
        policies = scripted if isinstance(scripted, Mapping) else {"": scripted} if scripted is not None else {}
        entry = TaskEntry(
            task=_checked(env_id, path, _OBJECT, "module:Class"),
            scripted={mode: _path_of(env_id, each, module) for mode, each in policies.items()},
            training=training if not isinstance(training, str) else _path_of(env_id, training, module),
            learned={name: _checked(env_id, each, _FOLDER, "package:folder") for name, each in (learned or {}).items()},
        )
        if env_id.startswith("DualUR10/") and not module.startswith("dual_ur10."):
            raise SettingsError(f"{env_id!r} as {path!r}: the namespace DualUR10 is that of this package. Use your own")
        known = TASKS.setdefault(env_id, entry)
        if known != entry:
            raise SettingsError(
                f"{env_id!r} is {known.task!r}, and cannot be {path!r}: it was registered by another package, or "
                "differently. Use a namespace of your own, or a new version"
            )
        _register(env_id)

    if task is not None:
        add(task)
        return None

    def decorate(task_type: TaskT) -> TaskT:
        add(_path_of(env_id, task_type, ""))
        return task_type

    return decorate


def _path_of(env_id: str, value: object, module: str) -> str:
    """Return "module:name" of a class, or of a name in a module."""
    if isinstance(value, type):
        if "." in value.__qualname__:
            raise SettingsError(
                f"{value.__qualname__!r} of {env_id} is defined within a class or function: define it at the top of "
                "its module, where other processes find it"
            )
        return f"{value.__module__}:{value.__qualname__}"
    text = value if isinstance(value, str) and ":" in value else f"{module}:{value}"
    return _checked(env_id, text, _OBJECT, 'a class, "module:name" or "name"')


def _checked(env_id: str, text: object, form: re.Pattern[str], wanted: str) -> str:
    if not isinstance(text, str) or form.fullmatch(text) is None:
        raise SettingsError(f"{env_id!r} with {text!r}: it must be {wanted}")
    return text


def _register(env_id: str) -> None:
    if env_id not in registry:
        register_with_gymnasium(
            env_id,
            entry_point="dual_ur10.envs.api.dual_arm_env:DualArmEnv",
            vector_entry_point="dual_ur10.envs.api.vector_env:DualArmVectorEnv",
            kwargs={"task": env_id},
        )
    # PettingZoo's registries warn of an id that they know.
    if env_id not in pettingzoo.parallel_registry:
        pettingzoo.register("parallel", env_id, "dual_ur10.envs:parallel_env", kwargs={"task": env_id})
    if env_id not in pettingzoo.aec_registry:
        pettingzoo.register("aec", env_id, "dual_ur10.envs:aec_env", kwargs={"task": env_id})


for _id in TASKS:
    _register(_id)
