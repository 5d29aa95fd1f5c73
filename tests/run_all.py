"""Runs all tests, so that those of emulated controllers are not disturbed by the others.

python tests/run_all.py [options of pytest]

Arms that are streamed to ask for more than half of two cores, in real time: one of these tests runs at a time. Tests of
controllers that wait more than they work come after them, two at a time. All others are beside them, and have only what
these leave.
"""

import os
import subprocess
import sys
import tempfile

ONE_AT_A_TIME = ["-m", "real_time"]
TWO_AT_A_TIME = ["-m", "emulated and not real_time", "-n", "2"]
BESIDE = ["-m", "not emulated", "-n", "2"]


def _give_way():
    """Run only where nobody else wants to."""
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    else:
        os.nice(19)


def main() -> int:
    """Run them, show first what the ones in real time say, and then the others."""
    pytest = [sys.executable, "-m", "pytest", *sys.argv[1:]]
    with tempfile.TemporaryFile("w+", errors="replace") as told:
        beside = subprocess.Popen([*pytest, *BESIDE], stdout=told, stderr=subprocess.STDOUT, preexec_fn=_give_way)
        try:
            alone = subprocess.run([*pytest, *ONE_AT_A_TIME], check=False).returncode
            pairs = subprocess.run([*pytest, *TWO_AT_A_TIME], check=False).returncode
            others = beside.wait()
        finally:
            beside.kill()
        told.seek(0)
        for line in told:
            sys.stdout.write(line)
    return alone or pairs or others


if __name__ == "__main__":
    sys.exit(main())
