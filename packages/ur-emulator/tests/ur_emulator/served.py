"""Commands that serve until Ctrl-C."""

import contextlib
import os
import signal
import subprocess
import sys

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "COLUMNS": "200"}


@contextlib.contextmanager
def served(*arguments):
    """Run a command that serves, and yield the lines that it prints. Ctrl-C has to end it well."""
    process = subprocess.Popen(
        [sys.executable, "-m", *arguments],
        env=ENVIRONMENT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        lines = []
        while not lines or "Ctrl-C" not in lines[-1]:
            lines.append(process.stdout.readline())
            assert lines[-1], (lines, process.stderr.read())
        yield lines
        os.kill(process.pid, signal.SIGINT)
        rest, errors = process.communicate(timeout=30.0)
        assert process.returncode == 0
        assert rest == "ended\n"
        assert "Traceback" not in errors
    finally:
        process.kill()
        process.communicate()
