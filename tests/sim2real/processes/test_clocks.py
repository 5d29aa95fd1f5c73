"""Row 53 of the table of faults in `docs/safety.md`: nothing that is done depends on the time of day."""

import ast
import inspect
import textwrap
from pathlib import Path

import dual_ur10

LABELS = {"recording/describe.py": {"now"}, "sim2real/latch.py": {"gmtime", "strftime"}}
"""Who asks for it, and writes it where people read it."""

TIME_OF_DAY = {"time", "time_ns", "now", "utcnow", "today", "gmtime", "localtime", "ctime", "asctime", "strftime"}
OWNERS = {"time", "datetime", "date", "dt"}


def asked(source):
    """Functions of `time` and `datetime` that tell the time of day, as far as they are called by these names."""
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
    root = Path(dual_ur10.__file__).parent
    found = {str(path.relative_to(root)): asked(path.read_text()) for path in sorted(root.rglob("*.py"))}
    assert len(found) > 100
    assert {name: names for name, names in found.items() if names} == LABELS


def test_who_asks_is_found():
    def code():
        import time
        from datetime import datetime

        return time.time(), time.monotonic(), datetime.now()

    assert asked(textwrap.dedent(inspect.getsource(code))) == {"time", "now"}
    assert asked("from time import time_ns, monotonic") == {"time_ns"}
