"""Checkpoints: learned policies as a folder of numbers and text, from which no code is ever run.

    policy.safetensors   the weights, float32, "policy.0.weight", "policy.0.bias", "policy.1.weight", ...;
                         "left. ..." and "right. ..." where each arm has a network of its own
    manifest.json        everything else; see `dual_ur10.policies.learned.manifest.Manifest`

The weights of an ACT are in model.safetensors, under LeRobot's names. LeRobot's own files stand beside it; see
`dual_ur10.policies.learned.lerobot_files`.

Both files are read once and in full. No link is followed, nothing is allocated that the manifest does not account for,
and a changed file is refused. A checksum shows damage and carelessness. It does not show who made a checkpoint: a
policy moves arms, so know whose policy moves yours.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import math
import os
import re
import shlex
import shutil
import stat
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import safetensors
from numpy.typing import NDArray
from safetensors.numpy import save as _serialised

from dual_ur10.assets.settings import Equipment
from dual_ur10.envs.core.options import IMAGE_OPTIONS, EnvOptions
from dual_ur10.envs.core.randomization import PRESETS, VISUAL, Randomization, resolve_randomization
from dual_ur10.errors import CheckpointError
from dual_ur10.ids import __version__, env_id_of, received
from dual_ur10.policies.learned import schema
from dual_ur10.policies.learned.act_network import ActShape
from dual_ur10.policies.learned.act_policy import ActPolicy
from dual_ur10.policies.learned.learned_policy import LearnedPolicy
from dual_ur10.policies.learned.lerobot_files import lerobot_files
from dual_ur10.policies.learned.manifest import Manifest, parse
from dual_ur10.policies.learned.signature import (
    OPTIONS,
    EnvironmentSignature,
    EnvironmentView,
    view_of,
    view_of_env,
    view_of_signature,
)
from dual_ur10.sim2real.control.adapter import scale_of_steps
from dual_ur10.sim2real.recording.header import plain
from ur_core.files import sync_folder

log = logging.getLogger(__name__)

WEIGHTS: Final = "policy.safetensors"
ACT_WEIGHTS: Final = "model.safetensors"
MANIFEST: Final = "manifest.json"

_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}", re.ASCII)
_MOST_HEADER: Final = 64 * 1024  # of the weights' file, beside the numbers

Networks = Sequence[Sequence[tuple[NDArray[Any], NDArray[Any]]] | Mapping[str, NDArray[Any]]]
"""For each network its layers, weight (out, in) and bias (out,), as PyTorch has them; or the tensors of an ACT."""


def save(folder: str | os.PathLike[str], networks: Networks, manifest: Manifest) -> Manifest:
    """Write a checkpoint: all of it or nothing. Nothing that exists is overwritten.

    Args:
        folder: New folder in one that exists. Its name has at most 64 letters, digits and _ . -.
        networks: Weights of float32, one network for each of `Manifest.names`.
        manifest: Manifest; the weights' checksum is filled in.

    Returns:
        The manifest as it was written.

    Raises:
        CheckpointError: The folder exists, cannot be written (a full disk), or has no legal name; or the weights do
            not fit the manifest. Nothing is left behind then.
    """
    path = check_new(folder)
    weights = _serialised(_tensors(networks, manifest))
    written = dataclasses.replace(manifest, weights_sha256=hashlib.sha256(weights).hexdigest())
    text = written.text().encode()
    part = path.with_name(f".{path.name}.{os.urandom(4).hex()}.part")
    try:
        os.mkdir(part)
    except OSError as error:
        raise CheckpointError(f"cannot write {path}: {_reason(error)}") from error
    try:
        _write(part / _weights_name(manifest), weights)
        _write(part / MANIFEST, text)
        for name, content in lerobot_files(written).items():
            _write(part / name, content)
        sync_folder(part)
        # Fails if something else is there by now; only an empty folder is replaced.
        os.rename(part, path)
        sync_folder(path.parent)
    except OSError as error:
        raise CheckpointError(
            f"cannot write {path}: {_reason(error)}. Whatever was saved before is unchanged"
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return written


def check_new(folder: str | os.PathLike[str]) -> Path:
    """Check that a checkpoint can be saved here, before the work that it is to hold. Return its absolute path.

    Raises:
        CheckpointError: It exists, or has no legal name.
    """
    path = Path(os.path.abspath(folder))
    if not _NAME.fullmatch(path.name):
        raise CheckpointError(
            f"{path.name!r:.80} is no name of a checkpoint: use at most 64 letters, digits and _ . -, first of "
            "all a letter, a digit or _"
        )
    if os.path.lexists(path):
        raise CheckpointError(f"{path} exists, and nothing is overwritten: choose another name, or move it away")
    return path


def policy_of(manifest: Manifest, networks: Networks) -> LearnedPolicy | ActPolicy:
    """Return the policy with these weights."""
    made: Any = networks
    return (ActPolicy if isinstance(manifest.network, ActShape) else LearnedPolicy)(manifest, made)


def manifest_of(policy: object) -> Manifest | None:
    """Return the manifest of a learned policy, or of the one that an executor of chunks asks; None: it is none."""
    source = getattr(policy, "source", policy)
    return source.manifest if isinstance(source, LearnedPolicy | ActPolicy) else None


def load(folder: str | os.PathLike[str], env: Any = None, **keywords: Any) -> LearnedPolicy | ActPolicy:
    """Load the policy of a checkpoint, after a check that it was made for this environment.

    The policy of an ACT is a chunk policy, of which `dual_ur10.policies.load` makes a policy.

    Args:
        folder: Folder of the checkpoint.
        env: An environment with any of the interfaces, or the id of one; None: that of the checkpoint.
        **keywords: As for `gym.make`, where `env` is an id or None. With neither, those of the checkpoint.

    Raises:
        CheckpointError: It cannot be read, was changed since it was saved, or is of another task, rate, latency,
            action, robot or version.
        DualUR10Error: The keywords make no environment.
    """
    path = Path(os.path.abspath(folder))
    manifest, networks, _ = _read(path)
    if env is None and not keywords:
        view = view_of_signature(manifest.signature)
    elif env is None or isinstance(env, str):
        _check_id(path, manifest, env)
        view = view_of(manifest.signature.env_id, keywords)
    elif keywords:
        raise CheckpointError("keywords were given beside an environment that has its own: pass its id, or no keywords")
    else:
        view = view_of_env(env)
    _check(path, manifest, view)
    return policy_of(manifest, networks)


def read(folder: str | os.PathLike[str]) -> tuple[Manifest, Networks]:
    """Return the manifest and the weights of a checkpoint.

    Raises:
        CheckpointError: It cannot be read, or was changed since it was saved.
    """
    return _read(Path(os.path.abspath(folder)))[:2]


def read_manifest(folder: str | os.PathLike[str]) -> Manifest:
    """Return the manifest of a checkpoint, after a check of the weights as well.

    Raises:
        CheckpointError: It cannot be read, or was changed since it was saved.
    """
    return _read(Path(os.path.abspath(folder)))[0]


def sha256_of(folder: str | os.PathLike[str]) -> str:
    """Return the hash of a checkpoint's manifest, which holds that of its weights, after a check of both.

    Raises:
        CheckpointError: It cannot be read, or was changed since it was saved.
    """
    text = _read(Path(os.path.abspath(folder)))[2]
    return hashlib.sha256(text).hexdigest()


def signature_of(env: Any, **keywords: Any) -> EnvironmentSignature:
    """Return the signature of an environment, for the manifest of a policy that is made for it.

    Args:
        env: An environment with any of the interfaces, or the id of one.
        **keywords: As for `gym.make`, where `env` is an id.

    Raises:
        CheckpointError: It is no environment.
    """
    return (view_of(env, keywords) if isinstance(env, str) else view_of_env(env)).signature


def _tensors(networks: Networks, manifest: Manifest) -> dict[str, NDArray[np.float32]]:
    names, shapes = manifest.names, manifest.network.tensors
    flat = [each if isinstance(each, Mapping) else _flat_layers(each) for each in networks]
    if len(flat) != len(names) or any(each.keys() != shapes.keys() for each in flat):
        raise CheckpointError(
            f"there are {[len(each) for each in flat]} tensors in the layers of the networks: {manifest.agents} needs "
            f"{[len(shapes)] * len(names)}, {', '.join(shapes):.200}"
        )
    return {
        f"{name}.{key}": _checked(f"{name}.{key}", np.asarray(each[key]), shape)
        for name, each in zip(names, flat, strict=True)
        for key, shape in shapes.items()
    }


def _flat_layers(layers: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    return {
        f"{k}.{kind}": array
        for k, layer in enumerate(layers)
        for kind, array in zip(("weight", "bias"), layer, strict=True)
    }


def _weights_name(manifest: Manifest) -> str:
    return ACT_WEIGHTS if isinstance(manifest.network, ActShape) else WEIGHTS


def _checked(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[np.float32]:
    if array.dtype != np.float32 or array.shape != shape:
        raise CheckpointError(f"{name} is {array.dtype} of shape {array.shape}: it must be float32 of shape {shape}")
    if not np.isfinite(array).all():
        raise CheckpointError(f"{name} holds NaN or infinity: the training has diverged, or the file is damaged")
    return np.ascontiguousarray(array)


def _write(path: Path, content: bytes) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _reason(error: OSError) -> str:
    return error.strerror or str(error)


def _read(path: Path) -> tuple[Manifest, Networks, bytes]:
    try:
        # Everything through one handle: exchanging the folder meanwhile has no effect.
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        found = "it is a file" if path.is_file() else str(error)
        raise CheckpointError(
            f"{path} cannot be read as a checkpoint: {found}. A checkpoint is a folder, and no link to one, with "
            f"{MANIFEST} and {WEIGHTS} in it{_remedy_of(path)}"
        ) from None
    try:
        where = f"{path}/{MANIFEST}"
        text = _content(folder, MANIFEST, schema.MOST_BYTES, where)
        manifest = parse(text, where)
        size = 4 * manifest.network.parameters * len(manifest.names)
        name = _weights_name(manifest)
        where = f"{path}/{name}"
        weights = _content(folder, name, size + _MOST_HEADER, where)
    finally:
        os.close(folder)
    found = hashlib.sha256(weights).hexdigest()
    if found != manifest.weights_sha256:
        raise CheckpointError(
            f"{where} is not the file that was saved: its sha256 is {found[:12]}..., the manifest has "
            f"{manifest.weights_sha256[:12] or 'none'}...: get the checkpoint anew"
        )
    return manifest, _networks(weights, manifest, where), text


def _remedy_of(path: Path) -> str:
    """Return advice for a file in place of a checkpoint; only its type is read."""
    if not (path.is_file() and zipfile.is_zipfile(path)):
        return ""
    return (
        ". It looks like a file of Stable-Baselines3, which runs whatever code is in it when it is read: if you know "
        f"who made it, `dual-ur10 convert {shlex.quote(str(path))} ENV --out FOLDER --trust-pickle` makes a checkpoint "
        "of it"
    )


def _content(folder: int, name: str, most: int, where: str) -> bytes:
    """Return a regular file's content if it is not larger than `most` bytes."""
    try:
        # Without O_NONBLOCK, opening a pipe would wait for a writer.
        file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder)
    except OSError as error:
        raise CheckpointError(f"{where} cannot be read: {_reason(error)}; links are not followed") from None
    try:
        status = os.fstat(file)
        if not stat.S_ISREG(status.st_mode):
            raise CheckpointError(f"{where} is no regular file: get the checkpoint anew")
        if status.st_size > most:
            raise CheckpointError(f"{where} has {status.st_size} bytes: at most {most} are expected, nothing was read")
        with os.fdopen(file, "rb", closefd=False) as stream:
            content = stream.read(most + 1)
    except OSError as error:
        raise CheckpointError(f"{where} cannot be read: {_reason(error)}") from None
    finally:
        os.close(file)
    if len(content) > most:
        raise CheckpointError(f"{where} grew while it was read: at most {most} bytes are expected")
    return content


def _networks(content: bytes, manifest: Manifest, where: str) -> Networks:
    try:
        parts = safetensors.deserialize(content)  # type: ignore[no-untyped-call]  # has no types
        found = {name: (value["dtype"], value["shape"], value["data"]) for name, value in parts}
    except Exception as error:  # its reader raises many kinds
        raise CheckpointError(f"{where} cannot be read as safetensors: {error!s:.200}") from None
    shapes = manifest.network.tensors
    expected = [f"{name}.{key}" for name in manifest.names for key in shapes]
    if sorted(found) != sorted(expected):
        raise CheckpointError(f"{where} holds {sorted(found)!r:.200}: expected are {sorted(expected)!r:.200}")

    def array(name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
        kind, size, data = found[name]
        if kind != "F32" or tuple(size) != shape or len(data) != 4 * math.prod(shape):
            raise CheckpointError(f"{where}: {name} is {kind} of shape {tuple(size)}: expected is F32 of {shape}")
        return _checked(f"{where}: {name}", np.frombuffer(data, dtype="<f4").astype(np.float32).reshape(shape), shape)

    flat = [{key: array(f"{name}.{key}", shape) for key, shape in shapes.items()} for name in manifest.names]
    if isinstance(manifest.network, ActShape):
        return flat
    count = len(manifest.network.pairs)
    return [[(each[f"{k}.weight"], each[f"{k}.bias"]) for k in range(count)] for each in flat]


def _check_id(path: Path, manifest: Manifest, env: str | None) -> None:
    made = manifest.signature.env_id
    if env is not None and env_id_of(env) != made:
        raise CheckpointError(
            f"{path} is of {made}, the environment is {env_id_of(env)}: load one that was made for it"
        )


_REMEDIES: Final = {
    "env_id": "load a checkpoint of that task",
    "robot.model": "use these arms, or train with those of the environment",
    "rate.tick_s": "use controllers of that family, or train with it",
    "rate.period_ticks": "",
    "rate.latency_ticks": "",
    "actions.mode": "",
    "actions.compensate_lag": "",
    "actions.joint_step_rad": "train with the speed caps of this cell: they protect it",
    "robot.family": "use controllers of that family, or train with it",
    "robot.lookahead_s": "set servoj's lookahead_s as it was in training",
    "robot.gain": "set servoj's gain as it was in training",
}

_ONLY_WARNED: Final = ("kwargs", "robot.nominal_dh", "robot.bases", "robot.tools")

_KEYWORD_OF: Final = {
    "view": "observation",
    "rate.period_ticks": "policy_rate_hz",
    "rate.latency_ticks": "action_latency_ticks",
    "actions.mode": "action_mode",
    "kwargs.action_scale": "action_scale",
    **{f"kwargs.{name}": name for name in IMAGE_OPTIONS},
    "actions.compensate_lag": "compensate_lag",
}
"""Keywords of the environment that set these alone."""


def _check(path: Path, manifest: Manifest, view: EnvironmentView) -> None:
    made, version = manifest.signature, manifest.versions["dual_ur10"]
    if version.split(".")[:2] != __version__.split(".")[:2]:
        raise CheckpointError(
            f"{path} was made with dual_ur10 {version}, this is {__version__}: install a version "
            f"{'.'.join(version.split('.')[:2])}, or train it anew"
        )
    here = view.signature
    misfits = list(_misfits(made, here))
    for name, then, now in misfits:
        remedy = _REMEDIES.get(name, "make the environment with the keywords of the training")
        if name in _KEYWORD_OF:
            remedy = _same_keywords(made, [each for each, *_ in misfits if each in _KEYWORD_OF])
        raise CheckpointError(f"{path} was made for {name} {_shown(then)}, the environment has {_shown(now)}: {remedy}")
    _warn(str(path), made, view)


def _same_keywords(made: EnvironmentSignature, names: Sequence[str]) -> str:
    """Return the call of `gym.make` and of `load` that agree with a checkpoint in these entries."""
    default = EnvOptions()
    values = {name: made.kwargs.get(name, getattr(default, name, None)) for name in map(_KEYWORD_OF.__getitem__, names)}
    call = ", ".join([repr(made.env_id), *(f"{name}={value!r}" for name, value in values.items())])
    return f"pass what it was trained with to both, gym.make({call}) and load(..., {call})"


def warn_outside(policy: object, env: Any) -> None:
    """Warn once of what differs between the training of a learned policy and an environment in which it is to act.

    Raises:
        CheckpointError: It is no environment of this package.
    """
    manifest = manifest_of(policy)
    if manifest is not None:
        _warn(repr(policy), manifest.signature, view_of_env(env))


def _misfits(made: EnvironmentSignature, here: EnvironmentSignature) -> Iterator[tuple[str, Any, Any]]:
    """Yield name and both values of whatever must be as in training and is not."""
    left, right = _flat(made), _flat(here)
    if made.actions.mode == here.actions.mode:
        then, now = (each.kwargs.get("action_scale", EnvOptions.action_scale) for each in (made, here))
        try:
            same = (scale_of_steps(made.actions.mode, then) == scale_of_steps(made.actions.mode, now)).all()
        except ValueError as error:
            raise CheckpointError(f"its kwargs make no environment: {error!s:.300}") from error
        if not same:
            yield "kwargs.action_scale", then, now
    for option in IMAGE_OPTIONS if made.view == here.view == "both" else ():
        then, now = (plain(each.kwargs.get(option, getattr(EnvOptions, option))) for each in (made, here))
        if then != now:
            yield f"kwargs.{option}", then, now
    for name in dict.fromkeys(("env_id", *_REMEDIES, *left)):
        if not name.startswith(_ONLY_WARNED) and not _same(left[name], right[name]):
            yield name, left[name], right[name]


def _warn(what: str, made: EnvironmentSignature, view: EnvironmentView) -> None:
    here = view.signature
    found = [f"{name} was {_shown(then)} and is {_shown(now)}" for name, then, now in _misfits(made, here)]
    found += [*_other_keywords(made, here, view), *_wider(made, view)]
    if made.robot.nominal_dh != here.robot.nominal_dh:
        found.append("the kinematics of one of both arms are calibrated, and those of the other are not")
    found += _moved(made, here)
    if made.robot.tools != here.robot.tools:
        found.append(f"the tools were {_shown(made.robot.tools)} and are {_shown(here.robot.tools)}")
    text = f"{what} is used outside of its training, and may perform worse: {'; '.join(found)}"
    if found and text not in _WARNED:
        _WARNED.add(text)
        log.warning("%s", text)


_WARNED: Final[set[str]] = set()  # each text once, however often a checkpoint is loaded


def _other_keywords(made: EnvironmentSignature, here: EnvironmentSignature, view: EnvironmentView) -> list[str]:
    """Return a text on each keyword with another value than in training."""
    settings = view.setup.settings
    defaults = dataclasses.asdict(type(settings)())
    try:
        with received("the checkpoint"):
            trained = type(settings)(**{name: value for name, value in made.kwargs.items() if name in defaults})
    except (ValueError, TypeError) as error:
        raise CheckpointError(f"its kwargs make no environment: {error!s:.300}") from error
    covered = view.setup.task_type.covered(trained, settings)
    names = sorted({*made.kwargs, *here.kwargs} - {*OPTIONS} - covered)
    values = [(name, *(each.kwargs.get(name, defaults.get(name)) for each in (made, here))) for name in names]
    return [f"{name} was {_shown(then)} and is {_shown(now)}" for name, then, now in values if then != now]


def _wider(made: EnvironmentSignature, view: EnvironmentView) -> list[str]:
    """Return a text on each range of the randomization that exceeds those of the training and of "mild".

    "mild" is about a well-maintained cell, which is what every policy meets.
    """
    trained = _randomization(made)
    here, mild = view.setup.randomization, PRESETS["mild"]
    # The spread of an object's pose shows in the task's keywords.
    names = {each.name for each in dataclasses.fields(here)} - {"object_spread"}
    if view.setup.requirements.equipment == Equipment():
        names -= {name for name in names if name.startswith(("object_", "grip_"))}
    if not view.setup.options.pictured:
        names -= {*VISUAL}
    ranges = [(name, *(getattr(each, name) for each in (trained, mild, here))) for name in sorted(names)]
    return [
        f"randomization {name} was {then:g} and is {now:g}" for name, then, low, now in ranges if now > max(then, low)
    ]


def _moved(made: EnvironmentSignature, here: EnvironmentSignature) -> list[str]:
    """Return a text on bases farther from those of the training than any cell of its randomization, or of "mild"."""
    away_m, turn_rad = made.robot.bases_away(here.robot)
    ranges = (_randomization(made), PRESETS["mild"])
    room_m = math.sqrt(3.0) * max(each.base_shift_m for each in ranges)
    if away_m <= room_m and turn_rad <= max(each.base_turn_rad for each in ranges):
        return []
    return [f"a base is {away_m * 1e3:.1f} mm and {math.degrees(turn_rad):.2f} degrees from its place in training"]


def _randomization(made: EnvironmentSignature) -> Randomization:
    try:
        return resolve_randomization(made.kwargs.get("randomization", "none"))
    except (ValueError, TypeError) as error:
        raise CheckpointError(f"its kwargs make no environment: {error!s:.300}") from error


def _flat(signature: EnvironmentSignature) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name, value in dataclasses.asdict(signature).items():
        if isinstance(value, Mapping) and name != "kwargs":
            result.update({f"{name}.{inner}": each for inner, each in value.items()})
        else:
            result[name] = value
    return result


def _same(made: Any, here: Any) -> bool:
    """Return True if two values are equal, numbers up to rounding."""
    if isinstance(made, tuple) and isinstance(here, tuple):
        return len(made) == len(here) and all(map(_same, made, here))
    if isinstance(made, float) and isinstance(here, float):
        return bool(abs(made - here) <= 1e-6 * max(abs(made), abs(here)))
    return type(made) is type(here) and bool(made == here)


def _shown(value: Any) -> str:
    return f"{value!r:.120}"
