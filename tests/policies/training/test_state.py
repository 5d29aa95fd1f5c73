"""State of a training."""

from __future__ import annotations

import errno
import os
import pickle

import numpy as np
import pytest

from dual_ur10.errors import TrainingError
from dual_ur10.policies.training import state

TENSORS = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b/0": np.array(3.5)}


def same(found, wanted):
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        np.testing.assert_array_equal(found[name], value)
        assert (found[name].dtype, found[name].shape) == (value.dtype, value.shape)


def test_a_saved_state_is_loaded(tmp_path):
    state.save(tmp_path / "state", TENSORS, {"steps": 3, "text": "ü"})
    tensors, values = state.load(tmp_path / "state")
    same(tensors, TENSORS)
    assert values == {"steps": 3, "text": "ü"}
    state.save(tmp_path / "state", {}, {"steps": 4})
    assert state.load(tmp_path / "state") == ({}, {"steps": 4})
    assert [each.name for each in tmp_path.iterdir()] == ["state"]


@pytest.mark.parametrize("call", ["fsync", "rename"])
@pytest.mark.parametrize("nth", [0, 1])
def test_a_full_disk_leaves_the_state_before(tmp_path, monkeypatch, call, nth):
    state.save(tmp_path / "state", TENSORS, {"steps": 3})
    real, count = getattr(os, call), 0

    def full(*arguments, **keywords):
        nonlocal count
        count += 1
        if count > nth:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(*arguments, **keywords)

    with monkeypatch.context() as patch:
        patch.setattr(os, call, full)
        with pytest.raises(TrainingError, match=r"No space left.*--resume"):
            state.save(tmp_path / "state", {"c": np.zeros(3)}, {"steps": 9})
    tensors, values = state.load(tmp_path / "state")
    same(tensors, TENSORS)
    assert values == {"steps": 3}


def test_an_end_between_two_renames_loses_no_state(tmp_path):
    state.save(tmp_path / "state", TENSORS, {"steps": 3})
    (tmp_path / "state").rename(tmp_path / "state.old")
    assert state.load(tmp_path / "state")[1] == {"steps": 3}
    state.save(tmp_path / "state", TENSORS, {"steps": 4})
    assert state.load(tmp_path / "state")[1] == {"steps": 4}


class Hostile:
    def __reduce__(self):
        return os.mkdir, ("pwned",)


@pytest.mark.parametrize("name", ["tensors.safetensors", "values.json"])
@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"[" * 100_000, b"\xff" * 64, pickle.dumps(Hostile())])
def test_malformed_files_are_refused_and_run_no_code(tmp_path, monkeypatch, name, content):
    monkeypatch.chdir(tmp_path)
    state.save(tmp_path / "state", TENSORS, {"steps": 3})
    (tmp_path / "state" / name).write_bytes(content)
    with pytest.raises(TrainingError, match=r"cannot be read|holds no"):
        state.load(tmp_path / "state")
    assert not (tmp_path / "pwned").exists()


def test_an_absent_state_is_refused(tmp_path):
    with pytest.raises(TrainingError, match="nothing was saved"):
        state.load(tmp_path / "state")


def test_single_files_are_written_completely_or_not(tmp_path, monkeypatch):
    path = tmp_path / "samples.safetensors"
    state.save_tensors(path, TENSORS)
    same(state.load_tensors(path), TENSORS)

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(TrainingError, match="No space left"):
        state.save_tensors(path, {})
    same(state.load_tensors(path), TENSORS)
    assert list(tmp_path.iterdir()) == [path]
