"""A session with a live page, for tests in a browser."""

import threading

import numpy as np

from dual_ur10.cli.live import buttons_of
from dual_ur10.cli.session import make
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.rendering.live.viewpoints import CAMERA, FOV_RAD
from dual_ur10.errors import DeviceUnpluggedError, RenderError
from dual_ur10.policies.operators.catalog import operator_with
from dual_ur10.policies.operators.page import PageDevice, open_page
from dual_ur10.policies.operators.session import LiveSession

RUN_S = 600.0
"""Longest time that a session runs, should a test hang."""


class Live:
    """A session with a page, in a thread or stepped by the test."""

    def __init__(self, keywords, *, task="Handover", policy=None, threaded=True):
        setup = EnvSetup.resolve(task, keywords)
        self.page = open_page(setup, buttons_of(setup, takes=True), port=0, cameras="none")
        self.env, actor = make(task, policy or "zero", keywords, 0)
        self.core = self.env.unwrapped.core
        self.operator = operator_with(PageDevice(self.page), self.core.setup)
        self.url = self.page.wait_until_ready()
        self.session = LiveSession(self.env, actor if policy else None, self.operator, self.page, 0)
        self.thread = threading.Thread(target=self._run, daemon=True)
        self._closing = False
        if threaded:
            self.thread.start()

    def _run(self):
        try:
            self.session.run(RUN_S)
        except (RenderError, DeviceUnpluggedError):
            if not self._closing:
                raise

    def close(self):
        self._closing = True
        self.page.memory.end()
        if self.thread.ident is not None:
            self.thread.join(20)
        self.page.close()
        self.env.close()


def on_screen(point, width, height):
    """Return where the page shows a point of the cell, px, before somebody moves the viewpoint."""
    position, at = map(np.array, CAMERA)
    forward = (at - position) / np.linalg.norm(at - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    away = np.asarray(point) - position
    scale = height / 2 / np.tan(FOV_RAD / 2) / (away @ forward)
    return width / 2 + scale * (away @ right), height / 2 - scale * (away @ up)
