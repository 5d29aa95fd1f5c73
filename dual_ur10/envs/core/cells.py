"""The cell of an environment, and the hook through which its run is recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Protocol

import numpy as np

from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.sim2real.cell.cell import CellRequest, CellState, CellStep
from dual_ur10.sim2real.control.adapter import Command
from dual_ur10.sim2real.control.clearance import Clearance
from ur_core.types import Array, Mask

RECORDING: Final = "dual_ur10.sim2real.recording.of_env"
"""Module that records runs. It loads only when there is something to record."""


class StepHook(Protocol):
    """Observer of the resets and steps of one cell, such as a recorder."""

    @property
    def failure(self) -> str:
        """Reason why something was not recorded; empty: none."""

    def resetting(self, rngs: Sequence[np.random.Generator], seed: int | None) -> None:
        """Prepare for a reset, before it samples from the generators."""

    def reset(self, observation: Array, state: CellState, sampled: Mapping[str, Any]) -> None:
        """Receive a reset: the observation, (1, O), the state and the randomized values by name."""

    def step(
        self, action: object, command: Command, step: Any, period: CellStep, ended_by: str, commander: Mask
    ) -> None:
        """Receive a step.

        Args:
            action: The action as it was given.
            command: The command that the gate released.
            step: A `dual_ur10.envs.core.core.Step`.
            period: The cell's step, with the true state at its end.
            ended_by: Reason of an early end of the episode; "": there is none.
            commander: (2,) True for an arm that a person commanded.
        """

    def event(self, kind: str, text: str) -> None:
        """Receive an event, such as a fault."""

    def close(self) -> None:
        """End, because the core closes. May be called twice."""


def request_for(setup: EnvSetup, n: int, *, threads: int, clearance: Clearance) -> CellRequest:
    """Return the request for the cell of an environment.

    Args:
        setup: Of the environment.
        n: Number of cells.
        threads: Threads to simulate on.
        clearance: Measures the distances on the path to a start.
    """
    return CellRequest(
        config=setup.config,
        ticks=setup.ticks,
        limits=setup.limits,
        clearance=clearance,
        n=n,
        threads=threads,
        latency_ticks=setup.latency_ticks,
        randomized=not setup.randomization.is_none,
        varied=setup.randomization.varied,
        contacts=setup.contacts,
        couples=setup.task_type.couples,
        confirm=setup.options.confirm,
        only=setup.options.arm,
        cameras=setup.options.camera_names if setup.options.pictured else (),
        views=setup.options.own_cameras,
        image_size=(setup.options.height, setup.options.width),
        system=setup.system,
    )
