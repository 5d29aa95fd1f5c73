"""Devices of tests below the classes of devices: raw reports, servos on a pseudo terminal, a page's shared memory."""

import fcntl
import os
import pty
import select
import struct
import threading
import tty
import types

import numpy as np

from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.rendering.live.memory import Handles
from dual_ur10.policies.operators import dynamixel
from dual_ur10.policies.operators.device import FULL_TWIST
from dual_ur10.policies.operators.page import PageDevice, open_page
from ur_core.processes.system import LOCAL

FOREVER_S = 1e9


class RawMouse:
    """SpaceMouse as a named pipe that keeps the boundaries of reports."""

    def __init__(self, folder, name, new=False):
        self.path, self.new = str(folder / name), new
        os.mkfifo(self.path)
        # Reading and writing, so that neither end waits for the other.
        self._file = os.open(self.path, os.O_RDWR | os.O_NONBLOCK)
        fcntl.fcntl(self._file, fcntl.F_SETFL, os.O_NONBLOCK | os.O_DIRECT)
        fcntl.fcntl(self._file, fcntl.F_SETPIPE_SZ, 1 << 20)  # 256 reports, as many as the kernel keeps for a device

    def send(self, *report):
        os.write(self._file, bytes(report))

    def axes(self, counts):
        """Send the counts of six axes as a device reports them."""
        counts = [round(each) for each in counts]
        if self.new:
            os.write(self._file, struct.pack("<B6h", 1, *counts))
        else:
            os.write(self._file, struct.pack("<B3h", 1, *counts[:3]))
            os.write(self._file, struct.pack("<B3h", 2, *counts[3:]))

    def deflect(self, twist):
        """Send the report of a cap that is deflected for a twist, (6,), forward, left and up."""
        share = np.asarray(twist) / FULL_TWIST * 350
        self.axes(-share[[1, 0, 2, 4, 3, 5]])

    def press(self, bits):
        self.send(3, bits, 0)

    def unplug(self):
        os.close(self._file)


class RawLeader:
    """Chain of Dynamixel servos, which answers from a thread of its own.

    Attributes:
        counts: Positions of the servos; set them at any time.
        fault: None, "silent", "crc", "error", "half" or "echo".
    """

    def __init__(self, servos=7):
        self.counts, self.fault, self.requests = [2048] * servos, None, 0
        self._own, other = pty.openpty()
        tty.setraw(other)
        self.path = os.ttyname(other)
        self._other, self._ends = other, threading.Event()
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()

    def place(self, joints_rad, opening=None, signs=(1, 1, -1, 1, 1, 1)):
        """Put the leader into a posture of its arm, with zero offsets, and a trigger that is open at 200° of 100°."""
        self.counts[:6] = [round(each) for each in np.asarray(joints_rad) * signs / (2 * np.pi) * 4096]
        if opening is not None:
            self.counts[6] = round((100 + 100 * opening) / 360 * 4096)

    def _answer(self):
        seen = b""
        wanted = dynamixel.position_request(range(1, len(self.counts) + 1))
        while not self._ends.is_set():
            if not select.select([self._own], [], [], 0.02)[0]:
                continue
            try:
                seen += os.read(self._own, 4096)
            except OSError:
                return
            while wanted in seen:
                seen = seen[seen.index(wanted) + len(wanted) :]
                self.requests += 1
                os.write(self._own, self._answers(wanted))

    def _answers(self, wanted):
        if self.fault == "silent":
            return b""
        made = bytearray(wanted if self.fault == "echo" else b"")
        for servo, count in enumerate(self.counts, 1):
            error = 2 if self.fault == "error" else 0
            made += dynamixel.packet(servo, dynamixel.STATUS, bytes([error]) + struct.pack("<i", count))
            if self.fault == "crc" and servo == 3:
                made[-1] ^= 1
            if self.fault == "half" and servo == 3:
                return bytes(made[:-4])
        return bytes(made)

    def unplug(self):
        self.close()

    def close(self):
        if self._ends.is_set():
            return
        self._ends.set()
        self._thread.join()
        os.close(self._own)
        os.close(self._other)


class _Process:
    """Process of a page that serves nobody."""

    is_alive = True
    pid = 0

    def wait(self, within_s):
        return True


def serving_nobody():
    """Return a system whose processes do nothing."""
    return types.SimpleNamespace(clock=LOCAL.clock, pid=0, spawn=lambda *_, **__: _Process())


class RawPage:
    """Live page without its process: what a browser would send is written into the memory that both share."""

    def __init__(self, task, buttons=(), **keywords):
        setup = EnvSetup.resolve(task, keywords)
        self.page = open_page(setup, buttons, port=0, cameras="none", system=serving_nobody())
        self.page.memory.enter_ready({"url": "http://127.0.0.1/"})
        self.page.memory.beat(LOCAL.clock.now_s() + FOREVER_S)
        self.device = PageDevice(self.page)

    @property
    def words(self):
        return self.page.memory.words

    def drag(self, poses, clutch, gripper=(np.nan, np.nan)):
        self.page.memory.put_handles(Handles(np.array(poses), np.array(clutch), np.array(gripper), 0.0))

    def press(self, *names):
        for name in names:
            self.page.memory.press(name)

    def close(self):
        self.page.close()
