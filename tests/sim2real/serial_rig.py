"""Emulated firmware at the other end of a faulty line, on a virtual clock."""

import contextlib
import errno
import os
import pty
import random
import threading
from collections import deque
from pathlib import Path

import numpy as np

from dual_ur10.sim2real.serial_arm.firmware import SerialFirmware
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from ur_emulator.virtual.virtual_system import VirtualProcess, VirtualSystem, World

STEP_S = 0.002


def trajectory(arms=("left",), points=5, duration_s=2.0, size_rad=0.4, start_rad=0.1):
    """Return a smooth motion from rest to rest."""
    time_s = np.linspace(0.0, duration_s, points)
    s = time_s / duration_s
    shape = (size_rad * np.linspace(1.0, -1.0, 6))[None, None] * np.ones((1, len(arms), 1))
    q = start_rad + (s**2 * (3 - 2 * s))[:, None, None] * shape
    qd = (6 * s * (1 - s) / duration_s)[:, None, None] * shape
    return JointTrajectory(arms, time_s, q, qd)


class FaultyLine:
    """One direction of a line: it loses, garbles and delays bytes.

    Attributes:
        loss, garble: Probability per byte.
        delay_s: Delay of all bytes.
        cut: True while nothing arrives.
    """

    def __init__(self, seed):
        self._random = random.Random(seed)
        self.loss = self.garble = self.delay_s = 0.0
        self.cut = False
        self._waiting = deque()

    def put(self, data, now_s):
        rng = self._random
        passed = bytes(
            rng.randrange(256) if self.garble and rng.random() < self.garble else byte
            for byte in data
            if not self.cut and not (self.loss and rng.random() < self.loss)
        )
        self._waiting.append((now_s + self.delay_s, passed))

    def take(self, now_s):
        data = b""
        while self._waiting and self._waiting[0][0] <= now_s:
            data += self._waiting.popleft()[1]
        return data


class Rig:
    """Host's system and end of the line, and the firmware.

    Attributes:
        path: (time, commanded positions) of the firmware at every step.
        at: Functions by the time of the motion at which they are called once.
    """

    def __init__(self, folder, firmware=None, seed=0):
        self.world = World()
        program = VirtualProcess(self.world, None, "program", self.world.scheduler.program)
        self.system = VirtualSystem(program, Path(folder))
        self.firmware = SerialFirmware() if firmware is None else firmware
        self.there, self.back = FaultyLine(seed), FaultyLine(seed + 1)
        self.path, self.at = [], {}
        self._machine = VirtualProcess(self.world, None, "firmware")

    def plug(self):
        """Return the host's end of a new line."""
        here, there = self.system.channel()
        self._machine.kill()
        self._machine = VirtualProcess(self.world, None, "firmware")
        self._machine.group.endpoints.append(there)
        self.world.scheduler.start(lambda: self._serve(there), self._machine.group, "firmware")
        return here

    def unplug(self):
        """Pull the plug: the host's port reports an error from now on, and the firmware hears nothing."""
        self.there.cut = self.back.cut = True
        self._unplugged = True

    _unplugged = False

    def _serve(self, end):
        clock = self.system.clock
        while True:
            now_s = clock.now_s()
            if self._unplugged:
                end.close()
            else:
                self.there.put(end.receive_now(4096) or b"", now_s)
            answers = self.firmware.receive(self.there.take(now_s), now_s)
            self.back.put(answers, now_s)
            data = self.back.take(now_s)
            with contextlib.suppress(OSError):  # the program has closed its end
                end.send_now(data)
            if self.firmware.q_rad is not None:
                self.path.append((now_s, self.firmware.q_rad))
                for after_s in [each for each in self.at if now_s >= self.path[0][0] + each]:
                    self.at.pop(after_s)()
            clock.sleep(STEP_S)

    @property
    def jump_rad(self):
        """Largest step of the commanded positions between two steps of the clock."""
        q = np.array([each for _, each in self.path])
        return float(np.abs(np.diff(q, axis=0)).max(initial=0.0))


@contextlib.contextmanager
def serial_port(firmware):
    """Yield the name of a pseudo-terminal at whose other end a firmware runs."""
    master, slave = pty.openpty()
    ended = threading.Event()

    def serve():
        now_s = 0.0
        os.set_blocking(master, False)
        while not ended.is_set():
            try:
                data = os.read(master, 4096)
            except OSError as error:
                if error.errno not in (errno.EAGAIN, errno.EIO):  # nothing has come, or nobody has opened it
                    raise
                data = b""
            now_s += STEP_S  # its own time: a busy machine must not wake its watchdog
            answers = firmware.receive(data, now_s)
            if answers:
                os.write(master, answers)
            ended.wait(STEP_S)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        ended.set()
        thread.join()
        os.close(master)
        os.close(slave)
