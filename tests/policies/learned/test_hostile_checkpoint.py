"""Checkpoints that try to run code or to open files."""

from __future__ import annotations

import base64
import io
import json
import os
import pickle
import shutil
import stat
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save as serialised

from dual_ur10.errors import CheckpointError
from dual_ur10.policies.learned import checkpoint
from tests.policies.learned.checkpoints import (
    content,
    edit,
    exchange_weights,
    leaves,
    put,
    sealed,
)
from tests.soak import SOAK


class Payload:
    """Make a folder when unpickled."""

    def __init__(self, sentinel: Path) -> None:
        self.sentinel = sentinel

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.sentinel),)


def corpus(sentinel: Path) -> dict[str, bytes]:
    """Return files of all kinds that run code if a reader trusts them."""
    payload = Payload(sentinel)
    found = {f"pickle {protocol}": pickle.dumps(payload, protocol) for protocol in range(6)}
    found["in a dict"] = pickle.dumps({"state_dict": {"weight": payload}})
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as zipped:
        for name in ("archive/data.pkl", "data", "policy.pth", "pytorch_variables.pth", "archive/version"):
            zipped.writestr(name, found["pickle 2"])
    found["zip"] = archive.getvalue()
    array = io.BytesIO()
    np.save(array, np.array([payload], dtype=object), allow_pickle=True)
    found["npy"] = array.getvalue()
    call = f"__import__('os').mkdir({str(sentinel)!r})"
    found["python"] = call.encode()
    found["yaml"] = f"!!python/object/apply:os.mkdir ['{sentinel}']".encode()
    found["json"] = json.dumps({"py/reduce": [{"py/function": "os.mkdir"}, {"py/tuple": [str(sentinel)]}]}).encode()
    found["sb3"] = json.dumps({":type:": "x", ":serialized:": base64.b64encode(found["pickle 4"]).decode()}).encode()
    return found


def test_the_payloads_run_code_where_they_are_trusted(tmp_path: Path) -> None:
    """Otherwise the tests below would prove nothing."""
    sentinel = tmp_path / "sentinel"
    found = corpus(sentinel)
    for name in ("pickle 0", "pickle 5", "in a dict", "python"):
        eval(found[name]) if name == "python" else pickle.loads(found[name])
        assert sentinel.is_dir()
        sentinel.rmdir()
    np.load(io.BytesIO(found["npy"]), allow_pickle=True)
    assert sentinel.is_dir()


def test_no_file_runs_code(saved: Path, tmp_path: Path) -> None:
    sentinel = tmp_path / "sentinel"
    for name, data in corpus(sentinel).items():
        for file in ("manifest.json", "policy.safetensors"):
            folder = Path(shutil.copytree(saved, tmp_path / "hostile"))
            (folder / file).write_bytes(data)
            for resealed in (False, True):
                if resealed and file == "policy.safetensors":
                    exchange_weights(folder, data)
                with pytest.raises(CheckpointError):
                    checkpoint.load(folder)
                assert not sentinel.exists(), (name, file)
            shutil.rmtree(folder)
    for name, data in corpus(sentinel).items():
        for file in ("policy.pkl", "vecnormalize.pkl", "policy.pth", "__init__.py", "sitecustomize.py", "policy.zip"):
            (saved / file).write_bytes(data)
        checkpoint.load(saved)
        assert not sentinel.exists(), name


def test_no_field_runs_code(saved: Path, tmp_path: Path) -> None:
    """A payload in any field or name is refused, or kept as plain text."""
    sentinel = tmp_path / "sentinel"
    value = content(saved)
    found = [path for path in leaves(value) if path and path[0] != "sha256"]
    texts = [base64.b64encode(data).decode() for data in corpus(sentinel).values()]
    texts += [data.decode("latin-1") for data in corpus(sentinel).values()]
    texts += [
        f"${{{texts[0]}}}",
        f"file://{sentinel}",
        "os.mkdir",
        f"$(mkdir {sentinel})",
        f"{{0.__class__}}{sentinel}",
    ]
    refused = kept = 0
    tried = [each for each in found if SOAK or not isinstance(each[-1], int) or each[-1] < 2]
    assert len(tried) > len(texts)
    for k, path in enumerate(tried):
        for text in texts if SOAK else [texts[k % len(texts)]]:  # each in some field, and each field with one
            for new in (put(value, path, text), put(value, path, {text[:64]: text}), put(value, path, [text])):
                (saved / "manifest.json").write_bytes(sealed(new))
                try:
                    checkpoint.load(saved)
                    kept += 1
                except CheckpointError:
                    refused += 1
    assert not sentinel.exists()
    assert refused > kept
    (saved / "manifest.json").write_bytes(sealed(value))
    _, layers, _ = checkpoint._read(saved)
    for text in texts:
        exchange_weights(saved, serialised({text: layers[0][0][0]}))
        with pytest.raises(CheckpointError):
            checkpoint.load(saved)
    assert not sentinel.exists()


def test_keywords_from_the_file_open_nothing(saved: Path, tmp_path: Path) -> None:
    """Keywords with paths and cells come from the caller alone."""
    pipe = tmp_path / "lab.toml"
    os.mkfifo(pipe)  # reading it would never end
    for name, new in (
        ("cell", str(pipe)),
        ("record", str(tmp_path / "new")),
        ("confirm", True),
        ("task", "x"),
        ("arm", "left"),
    ):
        edit(saved, lambda value, name=name, new=new: value["signature"].update(kwargs={name: new}))
        with pytest.raises(CheckpointError, match="unknown"):
            checkpoint.load(saved)
    assert sorted(os.listdir(tmp_path)) == ["copy", "lab.toml"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    for kwargs in (
        {"amplitude_m": "x"},
        {"amplitude_m": -1},
        {"amplitude_m": [1]},
        {"randomization": "x"},
        {"center_m": {}},
    ):
        edit(saved, lambda value, kwargs=kwargs: value["signature"].update(kwargs=kwargs))
        with pytest.raises(CheckpointError):
            checkpoint.load(saved)
