"""Checkpoints that are damaged or inconsistent are refused."""

from __future__ import annotations

import copy
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save as serialised

from dual_ur10.errors import CheckpointError
from dual_ur10.policies.learned import checkpoint, schema
from dual_ur10.policies.learned.network import Normaliser
from tests.policies.learned.checkpoints import (
    at,
    content,
    edit,
    exchange_weights,
    leaves,
    parts,
    put,
    sealed,
)
from tests.soak import SOAK


@pytest.mark.parametrize("resealed", [False, True])
@pytest.mark.parametrize("name", ["manifest.json", "policy.safetensors"])
def test_files_truncated_at_any_length_are_refused(name: str, resealed: bool, saved: Path) -> None:
    data = (saved / name).read_bytes()
    if name == "manifest.json":
        data = data.rstrip()  # its last line break has no meaning
    for length in range(0, len(data), 1 if SOAK else 40):
        if resealed and name == "policy.safetensors":
            exchange_weights(saved, data[:length])
        else:
            (saved / name).write_bytes(data[:length])
        with pytest.raises(CheckpointError):
            checkpoint.load(saved)


def test_any_changed_byte_of_the_weights_is_refused(saved: Path) -> None:
    path = saved / "policy.safetensors"
    data = path.read_bytes()
    for k in range(0, len(data), 1 if SOAK else 40):
        changed = bytearray(data)
        changed[k] ^= 1 << k % 8
        path.write_bytes(changed)
        with pytest.raises(CheckpointError, match="is not the file that was saved"):
            checkpoint.load(saved)


def test_any_changed_value_of_the_manifest_is_refused(saved: Path) -> None:
    value = content(saved)
    found = [path for path in leaves(value) if path and not isinstance(at(value, path), dict | list)]
    for path in found[:: 1 if SOAK else 30] + [each for each in found if not isinstance(each[-1], int)]:
        old = at(value, path)
        new = not old if isinstance(old, bool) else f"{old}x" if isinstance(old, str) else (old or 0) + 1
        (saved / "manifest.json").write_text(json.dumps(put(value, path, new)))
        with pytest.raises(CheckpointError, match=r"changed since|not of format"):
            checkpoint.load(saved)


def test_any_value_of_another_type_is_refused(saved: Path) -> None:
    value = content(saved)
    free = ("kwargs", "training", "evaluation")
    found = [path for path in leaves(value) if path and not any(name in path[:-1] for name in free)]
    for path in [each for k, each in enumerate(found) if SOAK or k % 30 == 0 or not isinstance(each[-1], int)]:
        old = at(value, path)
        for new in ("1", 7, True, [], {}, 0.5, 2**70):
            same = type(new) is type(old) or {type(new), type(old)} <= {int, float}
            if path[-1] in free and isinstance(new, dict):
                continue
            if same and new != 2**70:
                continue
            if new == 2**70 and isinstance(old, float):
                continue
            (saved / "manifest.json").write_bytes(sealed(put(value, path, new)))
            if path == ("normalisers",) and new == []:
                continue
            if path[0] == "sha256":
                continue
            with pytest.raises(CheckpointError):
                checkpoint.load(saved)


def test_missing_and_unknown_keys_are_refused(saved: Path) -> None:
    value = content(saved)
    for path in leaves(value):
        here = at(value, path)
        if not isinstance(here, dict) or any(name in path for name in ("kwargs", "training", "evaluation", "versions")):
            continue
        for name in here:
            less = copy.deepcopy(value)
            del at(less, path)[name]
            if name == "sha256":
                continue
            (saved / "manifest.json").write_bytes(sealed(less))
            with pytest.raises(CheckpointError, match=rf"has no|{name}|format"):
                checkpoint.load(saved)
        more = copy.deepcopy(value)
        at(more, path)["surprise"] = 1
        (saved / "manifest.json").write_bytes(sealed(more))
        with pytest.raises(CheckpointError, match="surprise"):
            checkpoint.load(saved)


def test_all_findings_are_reported_with_their_paths(saved: Path) -> None:
    def change(value: dict[str, Any]) -> None:
        value["signature"]["rate"]["tick_s"] = "fast"
        value["network"]["activation"] = "gelu"
        value["normalisers"][0]["mean"][3] = None
        value["training"]["text"] = "x" * 3000
        value["training"]["steps"] = 2**70
        del value["seed"], value["evaluation"]
        value["surprise"] = 1

    edit(saved, change)
    with pytest.raises(CheckpointError) as found:
        checkpoint.load(saved)
    for text in (
        "manifest.json.signature.rate.tick_s is 'fast': it must be a valid number",
        "manifest.json.network.activation is 'gelu': it must be 'tanh' or 'relu'",
        "manifest.json.normalisers[0].mean[3] is None",
        "manifest.json.training.text has 3000 characters: at most 2000 are allowed",
        "manifest.json.training.steps is 1180591620717411303424: it must be a whole number of 64 bits",
        "manifest.json.surprise is unknown: remove it",
    ):
        assert text in str(found.value)
    shutil.rmtree(saved)
    checkpoint.save(saved, *parts())
    edit(saved, lambda value: (value.pop("seed"), value["normalisers"][0].pop("clip")))
    with pytest.raises(CheckpointError, match=r"normalisers\[0\].clip is missing.*; .*seed is missing: write it down"):
        checkpoint.load(saved)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"null",
        b"[]",
        b"{}",
        b"\xff\xfe",
        b'{"format": "dual-ur10 policy 2"}',
        b'{"format": NaN}',
        b'{"a": 1, "a": 2}',
        b"[" * 200_000,
        b'{"a":' * 100_000,
        b"1" * 100_000,
        b" " * (2 << 20),
    ],
)
def test_malformed_manifests_are_refused(text: bytes, saved: Path) -> None:
    (saved / "manifest.json").write_bytes(text)
    with pytest.raises(CheckpointError):
        checkpoint.load(saved)


def test_duplicate_keys_are_refused(saved: Path) -> None:
    """Python takes the last value, other readers the first."""
    path = saved / "manifest.json"
    path.write_text(path.read_text().replace("{", '{"seed": 9,', 1))
    with pytest.raises(CheckpointError, match="a key twice"):
        checkpoint.load(saved)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_non_finite_numbers_are_refused(number: str, saved: Path) -> None:
    text = sealed(put(content(saved), ("normalisers", 0, "clip"), 987654.25)).decode()
    bare = text.replace("987654.25", number)
    (saved / "manifest.json").write_text(bare)
    with pytest.raises(CheckpointError):
        checkpoint.load(saved)
    with pytest.raises(CheckpointError, match="finite"):
        schema.read(Normaliser, {"mean": [1.0], "var": [1.0], "clip": float("inf"), "epsilon": 1.0}, "x")


def test_weights_of_another_layout_are_refused(saved: Path) -> None:
    _, layers, _ = checkpoint._read(saved)
    good = {
        f"policy.{k}.{kind}": array
        for k, layer in enumerate(layers[0])
        for kind, array in zip(("weight", "bias"), layer, strict=True)
    }
    bias = good["policy.0.bias"]
    bad: list[tuple[dict[str, Any], str]] = [
        ({**good, "more": bias}, "holds"),
        ({name: each for name, each in good.items() if name != "policy.0.bias"}, "holds"),
        ({**good, "policy.0.bias": bias.astype(np.float64)}, "F64"),
        ({**good, "policy.0.bias": bias.view(np.int32)}, "I32"),
        ({**good, "policy.0.bias": bias[:-1]}, "of shape"),
        ({**good, "policy.0.bias": bias[None]}, "of shape"),
        ({**good, "policy.0.weight": np.ascontiguousarray(good["policy.0.weight"].T)}, "of shape"),
        ({**good, "policy.0.bias": bias + np.float32(np.inf)}, "NaN or infinity"),
        ({**good, "policy.0.bias": bias * np.float32(np.nan)}, "NaN or infinity"),
    ]
    exchange_weights(saved, serialised(good))
    checkpoint.load(saved)
    for tensors, message in bad:
        exchange_weights(saved, serialised(tensors))
        with pytest.raises(CheckpointError, match=message):
            checkpoint.load(saved)


def test_files_that_announce_huge_sizes_are_refused(saved: Path) -> None:
    """The sizes stand in the header, or are those of a sparse file."""
    header = json.dumps({"policy.0.bias": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode()
    for data in (
        len(header).to_bytes(8, "little") + header,
        (2**63 - 1).to_bytes(8, "little") + header,
        (2**64 - 1).to_bytes(8, "little"),
        b"\0" * 8,
    ):
        exchange_weights(saved, data)
        with pytest.raises(CheckpointError, match="safetensors"):
            checkpoint.load(saved)
    with (saved / "policy.safetensors").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(CheckpointError, match="nothing was read"):
        checkpoint.load(saved)
    edit(saved, lambda value: value["network"].update(layers=[94, 10**9, 12]))
    with pytest.raises(CheckpointError, match="the network has"):
        checkpoint.load(saved)
    with (saved / "manifest.json").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(CheckpointError, match="nothing was read"):
        checkpoint.load(saved)


@pytest.mark.parametrize("name", ["manifest.json", "policy.safetensors"])
def test_links_and_special_files_are_not_followed(name: str, saved: Path) -> None:
    path = saved / name
    aside = saved.parent / "aside"
    path.rename(aside)
    path.symlink_to(aside)
    with pytest.raises(CheckpointError, match="links are not followed"):
        checkpoint.load(saved)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(CheckpointError, match="no regular file"):
        checkpoint.load(saved)
    path.unlink()
    path.mkdir()
    with pytest.raises(CheckpointError, match="no regular file"):
        checkpoint.load(saved)
    path.rmdir()
    with pytest.raises(CheckpointError, match="cannot be read"):
        checkpoint.load(saved)
    os.link(aside, path)
    checkpoint.load(saved)


def test_manifests_with_too_many_wrong_values_are_refused_early(saved: Path) -> None:
    """Each wrong value would take a kilobyte for its finding."""
    for count, message in ((300_000, r"at most 65536 values are read"), (60_000, r"; and 599\d\d more$")):
        wrong = put(content(saved), ("normalisers",), [0] * count)
        (saved / "manifest.json").write_bytes(sealed(wrong))
        with pytest.raises(CheckpointError, match=message) as found:
            checkpoint.load(saved)
        assert len(str(found.value)) < 1500


def test_a_path_that_is_no_folder_is_refused(saved: Path) -> None:
    link = saved.parent / "link"
    link.symlink_to(saved)
    for path in (link, saved / "manifest.json", saved.parent / "none", Path("/dev/null")):
        with pytest.raises(CheckpointError, match="cannot be read as a checkpoint"):
            checkpoint.load(path)
