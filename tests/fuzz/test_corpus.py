"""Every input that fuzzing kept or found, once through its target: no fuzzer is needed."""

from pathlib import Path

import pytest

from tests.fuzz.seeds import SEEDS
from tests.fuzz.targets import TARGETS

CORPUS = Path(__file__).parent / "corpus"
MOST_BYTES = 300_000


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_are_accepted(name):
    for data in SEEDS[name]:
        assert TARGETS[name](data)


@pytest.mark.parametrize("name", TARGETS)
def test_corpus_raises_nothing_unexpected(name):
    files = sorted((CORPUS / name).iterdir())
    assert files
    for file in files:
        try:
            TARGETS[name](file.read_bytes())
        except Exception as error:
            error.add_note(f"input: {file}")
            raise


def test_corpora_are_small_and_belong_to_targets():
    assert {each.name for each in CORPUS.iterdir()} == set(TARGETS)
    assert sum(each.stat().st_size for each in CORPUS.glob("*/*")) < MOST_BYTES
