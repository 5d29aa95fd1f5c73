"""Learned policies: networks, and the half of the observation that each of them receives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import ActionError, CheckpointError, UnknownNameError
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import Layer, Network, NetworkShape
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

Actions = NDArray[Any]


class LearnedPolicy:
    """Policy for both arms. It has no state: an action depends on one observation alone.

    Args:
        manifest: Manifest of the checkpoint.
        networks: Layers of each network, in the order of `Manifest.names`.

    Attributes:
        manifest: Manifest of the checkpoint.
        layers: Layers of each network.

    Raises:
        CheckpointError: The network is another.
    """

    def __init__(self, manifest: Manifest, networks: Sequence[Sequence[Layer]]) -> None:
        if not isinstance(manifest.network, NetworkShape):
            raise CheckpointError("the network returns chunks, not actions: it is an ACT")
        self.manifest, self.layers = manifest, networks
        self._joint = manifest.agents == "joint"
        self._size = manifest.signature.observation.shape[0]
        space = manifest.signature.action
        low, high = np.array(space.low, dtype=np.float32), np.array(space.high, dtype=np.float32)
        # Bounds of each agent's action are its half.
        sides = [slice(None)] if self._joint else [slice(0, len(low) // 2), slice(len(low) // 2, None)]
        normalisers = manifest.normalisers or (None,) * len(networks)
        of = [0, 1] if len(networks) == 2 else [0] * len(sides)
        self._networks = [
            Network(manifest.network, networks[k], low[side], high[side], normalisers[k])
            for k, side in zip(of, sides, strict=True)
        ]

    def __repr__(self) -> str:
        return f"LearnedPolicy({self.manifest.signature.env_id}, {self.manifest.agents}, {self.sha256[:12]})"

    @property
    def sha256(self) -> str:
        """Hash of the file of the weights: the same training gives the same one."""
        return self.manifest.weights_sha256

    def reset(self) -> None:
        """Do nothing: there is no state."""

    def begin(self, rows: Any, seeds: Sequence[int]) -> None:
        """Do nothing; see `dual_ur10.policies.policy.EpisodeAware`."""

    def __call__(self, observation: Array) -> Actions:
        """Return an action of float32 for an observation, or one for each row of a batch of observations.

        Raises:
            ActionError: Not an observation of its environment.
        """
        given = checked_observation(observation, self._size, self.manifest.signature.env_id)
        batch = given.reshape(-1, self._size)
        if self._joint:
            action = self._networks[0](batch)
        else:
            own = batch.reshape(len(batch), 2, -1)
            action = np.concatenate([network(own[:, side]) for side, network in enumerate(self._networks)], axis=1)
        return action.reshape(*given.shape[:-1], -1)

    def agent(self, arm: str) -> AgentPolicy:
        """Return the policy of one arm, which receives that arm's own observation as in PettingZoo's interface.

        Raises:
            UnknownNameError: No such arm, or one network acts for both together.
        """
        if self._joint or arm not in ARMS:
            raise UnknownNameError("agent of this policy", str(arm), [] if self._joint else list(ARMS))
        return AgentPolicy(self._networks[ARMS.index(arm)])


class AgentPolicy:
    """Policy for one arm, from its own observation."""

    def __init__(self, network: Network) -> None:
        self._network = network

    def reset(self) -> None:
        """Do nothing: there is no state."""

    def __call__(self, observation: Array) -> Actions:
        """Return an action of float32 for an observation of this arm, or one for each row of a batch.

        Raises:
            ActionError: Not an observation of one arm.
        """
        size = self._network.shape.layers[0]
        given = checked_observation(observation, size, "one agent")
        return self._network(given.reshape(-1, size)).reshape(*given.shape[:-1], -1)


def checked_observation(observation: object, size: int, whose: str) -> Array:
    """Return an observation, or a batch of them, as numbers, (size,) or (n, size).

    Raises:
        ActionError: It is none of this size.
    """
    given = np.asarray(observation)
    if given.dtype.kind not in "fiu" or given.ndim not in (1, 2) or given.shape[-1] != size:
        raise ActionError(
            f"an observation of {whose} is numbers of shape ({size},) or (n, {size}), found {given.dtype} of shape "
            f"{given.shape}"
        )
    return given.astype(np.float64, copy=False)
