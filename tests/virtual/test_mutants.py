"""Patches of the deliberate breaks: they apply, and fail loudly when they do not."""

import dataclasses
from pathlib import Path

import pytest

from tests.virtual import mutants
from tests.virtual.mutants import MUTANTS, PatchError, apply, copy, seeds_for
from tests.virtual.schedule import draw

ROOT = Path(__file__).parents[2]
LIBRARY = "packages/ur-core/ur_core/kernel/_kernel.so"


def test_there_are_30_of_them():
    assert len({each.name for each in MUTANTS}) == 30


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda each: each.name)
def test_a_patch_applies_and_gives_a_program(mutant, tmp_path):
    if mutant.path.endswith(".py"):
        compile(mutant.patched(ROOT), mutant.path, "exec")
        return
    copy(ROOT, tmp_path)
    before = (tmp_path / LIBRARY).read_bytes()
    apply(mutant, tmp_path)
    assert (tmp_path / LIBRARY).read_bytes() != before


def test_a_patch_that_no_longer_matches_fails():
    with pytest.raises(PatchError, match="0 times"):
        dataclasses.replace(MUTANTS[0], old="no such text").patched(ROOT)


def test_seeds_have_a_fault_that_concerns_the_break(monkeypatch):
    monkeypatch.setattr(mutants, "_MOST_SEEDS", 20)
    found = seeds_for(dataclasses.replace(MUTANTS[0], kinds=("slider",)))
    assert len(set(found)) == 20
    for seed in found:
        assert "slider" in {fault.kind for fault in draw(seed).faults}
