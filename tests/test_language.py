"""Words and sentences of the package, as far as a program can judge them."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("dual_ur10", "packages/ur-emulator/ur_emulator", "packages/ur-core/ur_core", "demo")
CLAUSES = {"What", "Whether", "Who", "How", "Where", "Why", "When"}
"""First words of summaries that are clauses, not noun phrases or imperatives."""

FOREIGN = {
    "knob": "fault injection",
    "pupil": "learner",
    "teacher": "expert",
    "posture": "configuration",
    "squeeze": "internal force",
    "twin": "collision model",
    "furnish": "scene requirements",
    "tells": "reports",
    "told": "reported",
    "says": "specifies",
    "drawn": "sampled",
    "rejoin": "recovery",
}
"""Words of an earlier dialect, and the field's words for the same."""


def documented(tree):
    """Yield modules, classes and functions of a syntax tree with their docstrings."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "name", "module"), text


def identifiers(tree):
    """Yield the names that a syntax tree binds."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr


@pytest.fixture(scope="module")
def trees():
    """Syntax trees by path: relative to `dual_ur10`, or with the name of another package in front."""
    found = {}
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            name = path.relative_to(ROOT).as_posix().removeprefix("dual_ur10/")
            found[name] = ast.parse(path.read_text())
    return found


def test_no_summary_is_a_clause(trees):
    found = [f"{path}: {name}" for path, tree in trees.items() for name, text in documented(tree)
             if text.split()[0].rstrip(",") in CLAUSES]  # fmt: skip
    assert found == []


def test_identifiers_are_the_fields_words(trees):
    found = set()
    for path, tree in trees.items():
        for name in {*identifiers(tree), *re.split(r"\W", path)}:
            words = {word.lower() for word in re.findall(r"[A-Z]?[a-z]+", name)}
            found |= {f"{path}: {name} ({FOREIGN[each]})" for each in FOREIGN if any(w.startswith(each) for w in words)}
    assert found == set()


def test_a_class_name_means_one_thing(trees):
    """Within the packages and the demonstration, names of single modules included."""
    allowed = {"_Command"}  # of one interface each: three command lines and the dashboard
    places = {}
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(f"{path}:{node.lineno}")
    assert {name: found for name, found in places.items() if len(found) > 1 and name not in allowed} == {}


def test_no_package_lists_its_neighbours(trees):
    """Which room imports which stands in `.importlinter`, which is checked."""
    listed = re.compile(r"\bimports\b|\bimported by\b|\bused by\b", re.IGNORECASE)
    packages = {path: ast.get_docstring(tree) or "" for path, tree in trees.items() if path.endswith("__init__.py")}
    assert [path for path, text in packages.items() if listed.search(text)] == []


def test_no_two_modules_share_a_name_in_sibling_rooms(trees):
    """Within one room that holds rooms, a file's name leads to one file."""
    allowed = {"__init__", "task", "path", "settings", "stages", "goals"}  # the parts of each task
    names = {}
    for path in trees:
        names.setdefault((path.split("/")[0], Path(path).stem), []).append(path)
    assert {key: paths for key, paths in names.items() if len(paths) > 1 and key[1] not in allowed} == {}
