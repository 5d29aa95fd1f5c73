"""Both arms for a program that commands and reads them whenever it likes, such as LeRobot's."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection, Pipe
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import ClosedError, LinkError, SettingsError
from dual_ur10.ids import env_id_of
from dual_ur10.lerobot.live_process import Exchange, run
from dual_ur10.lerobot.positions import Positions
from dual_ur10.policies.learned.signature import EnvironmentView
from dual_ur10.policies.operators.catalog import load_operator
from dual_ur10.policies.operators.device import LOST_S
from dual_ur10.policies.operators.operator import Operator
from dual_ur10.sim2real.commissioning.operator_prompts import ask_at_terminal
from ur_core.processes.child_process import Child
from ur_core.types import Array, Single

_END_S: Final = 30.0  # for both arms to stop, and processes to end

_INSTEAD: Final = {
    "action_mode": "leave it out, actions are joint positions",
    "observation": "leave it out, and give cameras for images",
    "height": "give size instead",
    "width": "give size instead",
}


class LiveArms:
    """Both arms, in simulation or on two controllers, which hold the positions that were commanded last.

    A process of its own steps the environment at its rate, through adapter and gate. Whatever the program does
    meanwhile, no deadline is missed; when it commands nothing, the arms hold their position, and jumps are led within
    the limits of motion. What ends the motion is raised by the next call. If the program ends, the arms stop, also on
    their path to the start.

    Args:
        env: Id of the environment, or its short form; "module:id" imports the module first. Its episode must not end by
            itself: "Free".
        cameras: Cameras whose images are observed: of the model, or of the cell.
        size: Height and width of an image.
        **keywords: Further keywords of the environment, such as `cell` and `robot`; they are pickled.

    Attributes:
        names: Names of the positions, 12 or 14: joints in rad, grippers from 0, closed, to 1, open.
        cameras: As given.
        size: As given.
        starts: Number of motions to the start so far.

    Raises:
        SettingsError: A keyword is one that this sets itself.
        DualUR10Error: A name or a value is not legal.
    """

    def __init__(
        self,
        env: str = "Free",
        *,
        cameras: Sequence[str] = (),
        size: tuple[int, int] = (480, 640),
        **keywords: Any,
    ) -> None:
        for name, instead in _INSTEAD.items():
            if name in keywords:
                raise SettingsError(f"{name} is set by {type(self).__name__} itself: {instead}")
        self._env_id = env_id_of(env)
        self._name = env if ":" in env else self._env_id  # the other process imports the module, too
        shown = {"observation": "both", "cameras": tuple(cameras), "height": size[0], "width": size[1]}
        self._keywords: Mapping[str, Any] = {
            "on_refusal": "terminate",
            **keywords,
            "action_mode": "joint_position",
            **(shown if cameras else {"observation": "state"}),
        }
        setup = EnvSetup.resolve(self._env_id, self._keywords)
        view = EnvironmentView(setup, setup.make_task(), setup.make_adapter())
        self.positions = Positions(view)
        self.names, self.cameras, self.size = self.positions.names, tuple(cameras), size
        self._asks = setup.config.controllers and setup.config.kind != "emulated"
        self._observed = 2 * view.layout.size
        self._process: Child | None = None
        self._exchange: Exchange | None = None
        self._connection: Connection | None = None
        self._ready = False
        self._error: BaseException | None = None
        self.starts = 0

    def __repr__(self) -> str:
        state = "started" if self.started else "not started"
        return f"{type(self).__name__}({self._env_id}, {len(self.names)} positions, {state})"

    @property
    def started(self) -> bool:
        """True while the arms can be commanded."""
        if not self._ready:
            return False
        self._receive()
        return self._error is None

    def start(self) -> None:
        """Move both arms to their start, which an operator confirms on real arms, and hold it.

        Whatever ends this early, such as Ctrl-C, also stops both arms.

        Raises:
            DualUR10Error: The arms are not ready, or the operator did not confirm.
        """
        if self.started:
            return
        self.stop()
        self._error = None
        try:
            self._start()
        except BaseException:
            self.stop()
            raise

    def _start(self) -> None:
        layout = {
            "target": (len(self.names),),
            "observation": (self._observed,),
            "images": (len(self.cameras), *self.size, 3),
        }
        self._exchange = Exchange(layout)
        self._connection, theirs = Pipe()
        with theirs:
            number, shared = theirs.fileno(), self._exchange.name
            work = (number, shared, layout, self._name, dict(self._keywords), self.cameras, os.getpid())
            self._process = Child(run, *work, files=[number], name="live-arms")
        while not self._ready:
            message, content = self._next()
            if self._error is not None:
                raise self._error
            if message == "confirm":
                confirmed = self._confirmed(content)
                with contextlib.suppress(OSError):  # it ended meanwhile, and the next message is why
                    self._connection.send(confirmed)
            self._ready = message == "ready"
        self.starts += 1

    def _confirmed(self, text: str) -> bool:
        return not self._asks or ask_at_terminal(text)

    def _next(self) -> tuple[str, Any]:
        """Wait for the next message of the process, and keep its error."""
        try:
            message, content = self._connection.recv() if self._connection is not None else ("", None)
        except (OSError, EOFError):
            message, content = "error", LinkError("the process that moves the arms has ended: start them again")
        if message == "error":
            self._error = content
        return message, content

    def _receive(self) -> None:
        """Keep the error of the process, if there is one."""
        if self._error is None and self._connection is not None and self._connection.poll():
            self._next()

    def stop(self) -> None:
        """Stop both arms on their path, and release them. May be called twice."""
        process, connection, exchange = self._process, self._connection, self._exchange
        self._process = self._connection = self._exchange = None
        self._ready = False
        if connection is not None:
            with contextlib.suppress(OSError):  # the process has ended
                connection.send(None)  # forked workers keep the connection open
            connection.close()
        if process is not None and not process.wait(_END_S):
            process.kill()
        if exchange is not None:
            exchange.close()

    def _check(self) -> Exchange:
        """Return the shared memory, if the arms can be commanded."""
        if self._ready:
            self._receive()
        if self._error is not None:
            raise self._error
        if self._exchange is None or not self._ready:
            raise ClosedError("the arms are not started, or were stopped: start them first")
        return self._exchange

    def observation(self) -> tuple[Single, Array, dict[str, NDArray[np.uint8]]]:
        """Return the newest positions, (12 or 14,), the environment's whole observation, and images by camera.

        Raises:
            ClosedError: The arms are not started.
            DualUR10Error: What ended the motion.
        """
        observation, images = self._check().observed()
        return self.positions.state(observation[None])[0], observation, dict(zip(self.cameras, images, strict=True))

    def command(self, positions: NDArray[np.floating]) -> None:
        """Command positions, (12 or 14,), which both arms approach within their limits from the next step on.

        Raises:
            ActionError: They are malformed. The arms hold what was commanded before.
            ClosedError: The arms are not started.
            DualUR10Error: What ended the motion.
        """
        exchange = self._check()
        exchange.command(self.positions.action(positions))

    def operator(self, device: str) -> Operator:
        """Return an operator of these arms with an input device."""
        return load_operator(device, self._env_id, self._keywords)


class LiveOperator:
    """Person who leads live arms with an input device.

    Who leads begins anew once the arms were started again, and after a pause of more than a second: a leader that was
    moved meanwhile is refused far from its arm, and else reached slowly.

    Args:
        arms: The arms, which are started.
        device: Device and its arguments, as for `--operator`.

    Raises:
        DualUR10Error: A name or a value is not legal, or the device cannot be opened.
    """

    def __init__(self, arms: LiveArms, device: str) -> None:
        self._arms, self._operator = arms, arms.operator(device)
        self._starts, self._asked_s = arms.starts, -math.inf

    def __call__(self) -> dict[str, float]:
        """Return the positions that the person commands, by name.

        Raises:
            DeviceError: One of its kinds: the device is gone, silent or not understood, or "stop" was pressed.
            DualUR10Error: What ended the motion.
        """
        _, observation, _ = self._arms.observation()
        now_s, starts = time.monotonic(), self._arms.starts
        if starts != self._starts:
            self._operator.reset()
        elif now_s - self._asked_s > LOST_S:
            self._operator.release()
        self._starts, self._asked_s = starts, now_s
        found = self._operator(observation)
        if self._arms.positions.stroke_m is not None:
            found[6::7] = (found[6::7] + 1.0) / 2.0
        return dict(zip(self._arms.names, map(float, found), strict=True))

    def close(self) -> None:
        """Close the device. May be called twice."""
        self._operator.close()
