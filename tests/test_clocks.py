"""Row 53 of the table of faults in `docs/reference/faults.md`: no behaviour depends on the time of day."""

import ast
import inspect
import textwrap
from pathlib import Path

import dual_ur10
import ur_core
import ur_emulator

LABELS = {"sim2real/recording/header.py": {"now"}, "processes/clock.py": {"now"}}
"""Modules that write the time of day into texts for people, and the functions they call."""

TIME_OF_DAY = {"time", "time_ns", "now", "utcnow", "today", "gmtime", "localtime", "ctime", "asctime", "strftime"}
OWNERS = {"time", "datetime", "date", "dt"}


def time_functions(source):
    """Return the functions of `time` and `datetime` that a source calls by name for the time of day."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module in OWNERS:
            found |= {each.name for each in node.names} & TIME_OF_DAY
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in OWNERS:
            found |= {node.attr} & TIME_OF_DAY
        if isinstance(node, ast.Name) and node.id in {"CLOCK_REALTIME"}:
            found.add(node.id)
    return found


def test_the_time_of_day_is_a_label_only():
    roots = [Path(each.__file__).parent for each in (dual_ur10, ur_core, ur_emulator)]
    found = {
        str(path.relative_to(root)): time_functions(path.read_text()) for root in roots for path in root.rglob("*.py")
    }
    assert len(found) > 100
    assert {name: names for name, names in found.items() if names} == LABELS


def test_calls_are_found():
    def code():
        import time
        from datetime import datetime

        return time.time(), time.monotonic(), datetime.now()

    assert time_functions(textwrap.dedent(inspect.getsource(code))) == {"time", "now"}
    assert time_functions("from time import time_ns, monotonic") == {"time_ns"}
