"""Tasks of one file: those of the suite, and that of the package `examples/two_arm_tasks`, which installs."""

import ast
import io
import tokenize
from pathlib import Path

import pytest

from dual_ur10 import tasks
from tests import scripts
from tests.two_arm_tasks import FOLDER, install

MODULES = {path: 150 for path in sorted((FOLDER / "two_arm_tasks").glob("*_*.py")) if path.stem != "__init__"}
MODULES |= {path: 215 for path in sorted(Path(tasks.__file__).parent.glob("*_*.py")) if path.stem != "__init__"}
"""Files with one task each, and their largest numbers of lines of code."""


def code_lines(text):
    """Return the number of lines that hold more than comments and docstrings."""
    rest = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    tokens = [each for each in tokenize.generate_tokens(io.StringIO(text).readline) if each.type not in rest]
    lines = {line for each in tokens for line in range(each.start[0], each.end[0] + 1)}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            lines -= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return len(lines)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: f"{path.parent.name}.{path.stem}")
def test_a_task_is_one_short_file_of_public_names(path):
    text = path.read_text()
    assert code_lines(text) <= MODULES[path]
    nodes = list(ast.walk(ast.parse(text)))
    imported = {each.module or "" for each in nodes if isinstance(each, ast.ImportFrom)}
    imported |= {alias.name for each in nodes if isinstance(each, ast.Import) for alias in each.names}
    assert imported == {"__future__", "collections.abc", "dataclasses", "typing", "numpy", "dual_ur10.tasks"}
    attributes = [each for each in nodes if isinstance(each, ast.Attribute)]
    assert not [each.attr for each in attributes if each.attr.startswith("_") and each.attr != "__init__"]
    of_facade = {each.attr for each in attributes if isinstance(each.value, ast.Name) and each.value.id == "ur"}
    assert len(of_facade) > 20
    assert of_facade <= set(tasks.__all__)


def test_it_installs_and_its_own_tests_pass(tmp_path):
    """Its copy, installed with its entry point, on every interface and on virtual cells."""
    pytest.importorskip("greenlet")
    install(tmp_path / "installed")
    scripts.run_tests(FOLDER / "tests", tmp_path / "installed", folder=tmp_path)
