"""State of a training, to continue from: numbers and text, from which no code is ever run."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import safetensors
from numpy.typing import NDArray
from safetensors.numpy import load as _parsed
from safetensors.numpy import save as _serialised

from dual_ur10.errors import TrainingError
from dual_ur10.policies.learned import schema
from ur_core.files import read_regular

Tensors = dict[str, NDArray[Any]]

_TENSORS: Final = "tensors.safetensors"
_VALUES: Final = "values.json"


def save(folder: Path, tensors: Mapping[str, NDArray[Any]], values: Mapping[str, Any]) -> None:
    """Replace the previous state. At every instant a complete state exists.

    Args:
        folder: Folder of the state. `folder.next` and `folder.old` are used, too.
        tensors: Arrays by name.
        values: Values of JSON by name.

    Raises:
        TrainingError: It cannot be written (a full disk). The previous state is unchanged.
    """
    part, old = folder.with_name(folder.name + ".next"), folder.with_name(folder.name + ".old")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        _write(part / _TENSORS, _serialised(_laid_out(tensors)))
        _write(part / _VALUES, json.dumps(dict(values), indent=1, allow_nan=False).encode())
        if folder.exists():
            shutil.rmtree(old, ignore_errors=True)
            folder.rename(old)
        part.rename(folder)
    except OSError as error:
        raise TrainingError(
            f"cannot save to {folder}: {error.strerror or error}. Whatever was saved before is unchanged: make room "
            "and continue with --resume"
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)


def exists(folder: Path) -> bool:
    """Return True if a state was saved."""
    return any(each.is_dir() for each in _places(folder))


def load(folder: Path) -> tuple[Tensors, dict[str, Any]]:
    """Return the tensors and values of the last state.

    Raises:
        TrainingError: No state was saved, or it cannot be read.
    """
    for each in _places(folder):
        if each.is_dir():
            return _read(each)
    raise TrainingError(f"{folder} does not exist: nothing was saved from which to continue")


def _places(folder: Path) -> tuple[Path, Path]:
    return folder, folder.with_name(folder.name + ".old")


def save_tensors(path: Path, tensors: Mapping[str, NDArray[Any]]) -> None:
    """Write tensors to a file: all or nothing.

    Raises:
        TrainingError: It cannot be written.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        _write(part, _serialised(_laid_out(tensors)))
        part.replace(path)
    except OSError as error:
        raise TrainingError(f"cannot save {path}: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


def load_tensors(path: Path) -> Tensors:
    """Read the tensors of a file.

    Raises:
        TrainingError: It cannot be read.
    """
    try:
        return dict(_parsed(read_regular(path)))
    except (OSError, safetensors.SafetensorError, KeyError, ValueError) as error:
        raise TrainingError(f"{path} cannot be read: {error!s:.200}") from error


def _read(folder: Path) -> tuple[Tensors, dict[str, Any]]:
    tensors = load_tensors(folder / _TENSORS)
    try:
        values = schema.loads(read_regular(folder / _VALUES, schema.MOST_BYTES), str(folder / _VALUES), TrainingError)
    except OSError as error:
        raise TrainingError(f"{folder / _VALUES} cannot be read: {error!s:.200}") from error
    if not isinstance(values, dict):
        raise TrainingError(f"{folder / _VALUES} holds no JSON object")
    return tensors, values


def _laid_out(tensors: Mapping[str, NDArray[Any]]) -> Tensors:
    # NumPy makes arrays of one value of single numbers.
    return {name: np.ascontiguousarray(each).reshape(np.shape(each)) for name, each in tensors.items()}


def _write(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
