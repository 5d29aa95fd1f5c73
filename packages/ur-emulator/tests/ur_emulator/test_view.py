"""The emulated arm in a browser."""

import shutil
import socket
import subprocess
import time
import urllib.request

import mujoco
import numpy as np
import pytest

from ur_emulator.emulated_controller import EmulatedController

iio = pytest.importorskip("imageio.v3")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def screenshot(url, path):
    flags = ("--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    size = ("--window-size=800,600", "--virtual-time-budget=8000", f"--screenshot={path}")
    subprocess.run([CHROMIUM, *flags, *size, url], capture_output=True, timeout=120, check=False)
    return iio.imread(path)[..., :3].astype(float)


def changed(first, second):
    """Count the pixels that differ."""
    return int((np.abs(first - second).max(axis=2) > 40.0).sum())


def pictures(url, path, enough, most=8):
    """Take pictures of the page, without black ones, until there are enough."""
    found = []
    for _ in range(3 * most):
        picture = screenshot(url, path)
        if np.ptp(picture) > 100.0:
            found.append(picture)
            if len(found) == most or enough(found):
                return found
    raise AssertionError("the viewer shows nothing")


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_a_browser_sees_the_arm_move(tmp_path):
    with EmulatedController("ur10", plant="nominal", view=True) as controller:
        url = controller.ask("info")["url"]
        assert url.startswith("http://127.0.0.1:")
        assert urllib.request.urlopen(url, timeout=10).status == 200
        if mujoco.__version__ < "4":  # its panels, which change by themselves, cover most of the cell
            pictures(url, tmp_path / "panels.png", bool)
            return
        # Drawn before the first state has come, arms lie stretched out: neither is to be mistaken for a move later.
        before = pictures(url, tmp_path / "before.png", lambda found: changed(found[0], found[-1]) > 3000)
        q = controller.ask("state", names=["actual_q"])["actual_q"]
        goal = [q[0] + 0.8, q[1] - 0.3, *q[2:]]
        with socket.create_connection((controller.host, 30003)) as client:
            client.sendall(f"movej({goal}, a=1.4, v=1.0)\n".encode())
            end = time.monotonic() + 30.0
            while time.monotonic() < end:
                now = controller.ask("state", names=["actual_q"])["actual_q"]
                if np.allclose(now, goal, atol=1e-3):
                    break
                time.sleep(0.05)

        def moved(found):
            return min(changed(found[-1], each) for each in before) > 3000

        assert moved(pictures(url, tmp_path / "after.png", moved))
