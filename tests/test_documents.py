import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FAULTS = 62


def rows():
    """Number and last column of each row of the table of faults."""
    text = (ROOT / "docs" / "safety.md").read_text()
    return [(int(row), shown) for row, shown in re.findall(r"^\| (\d+) \|.*\| ([^|]*) \|$", text, re.MULTILINE)]


def test_the_table_of_faults_is_complete():
    assert [row for row, _ in rows()] == list(range(1, FAULTS + 1))


def test_what_the_table_of_faults_names_exists():
    """Each file is there, and one of `tests/live/faults` has a test with the number of the row in its name."""
    numbers = {}
    for path in (ROOT / "tests" / "live" / "faults").glob("test_*.py"):
        names = re.findall(r"^def test_((?:\d+_)+)", path.read_text(), re.MULTILINE)
        numbers[path.stem] = {int(each) for name in names for each in name.split("_") if each}
    for row, shown in rows():
        named = re.findall(r"`([\w/]+)`", shown)
        assert named or shown == "—", f"row {row} names no test and does not say so"
        for name in named:
            assert (ROOT / "tests" / f"{name}.py").is_file(), f"row {row}: {name}"
            if name.startswith("live/faults/"):
                assert row in numbers[name.removeprefix("live/faults/")], f"row {row}: {name} has no test of it"


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    for target, anchor in re.findall(r"\]\((?!http)([^)#]*)#?([^)]*)\)", path.read_text()):
        there = path.parent / target if target else path
        assert there.exists(), target
        if anchor:
            titles = re.findall(r"^#+ (.*)$", there.read_text(), re.MULTILINE)
            assert anchor in [re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in titles], anchor
