"""Runs all tests: those of emulated controllers one after the other, and the others beside them.

python tests/run_all.py [options of pytest]

Emulated controllers and their clients run in real time, and ask for more than half of two cores: two of these tests at
a time fail on a slow machine. Their processes have a better priority than the other tests, which take what is left.
"""

import subprocess
import sys
import tempfile


def main() -> int:
    """Run both, show first what the ones in real time say, and then the others."""
    pytest = [sys.executable, "-m", "pytest", *sys.argv[1:]]
    with tempfile.TemporaryFile("w+", errors="replace") as told:
        beside = subprocess.Popen([*pytest, "-m", "not real_time"], stdout=told, stderr=subprocess.STDOUT)
        try:
            in_real_time = subprocess.run([*pytest, "-m", "real_time"], check=False).returncode
            others = beside.wait()
        finally:
            beside.kill()
        told.seek(0)
        for line in told:
            sys.stdout.write(line)
    return in_real_time or others


if __name__ == "__main__":
    sys.exit(main())
