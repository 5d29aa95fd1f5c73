"""Learned chunk policies: a transformer, and the actions that its outputs stand for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dual_ur10.errors import ActionError, CheckpointError
from dual_ur10.policies.learned.act_network import ActNetwork, ActShape, ActTensors
from dual_ur10.policies.learned.learned_policy import checked_observation
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import Normaliser
from ur_core.types import Array, Single


class ActPolicy:
    """Chunk policy for both arms. It has no state: a chunk depends on one observation alone.

    Args:
        manifest: Manifest of the checkpoint, whose network is an `ActShape`.
        networks: Weights of its one network.

    Attributes:
        manifest: Manifest of the checkpoint.
        layers: As given.
        dt_s: Time between two actions of a chunk.
        action_mode: See `dual_ur10.policies.chunks.chunk_policy.ChunkPolicy`.
        latency_s: Time after which a chunk counts in simulation: one action, as on controllers.
        portable: A child process may ask it.

    Raises:
        CheckpointError: The network is another.
    """

    portable = True

    def __init__(self, manifest: Manifest, networks: Sequence[ActTensors]) -> None:
        if not isinstance(manifest.network, ActShape):
            raise CheckpointError("the network returns no chunks: it is no ACT")
        self.manifest, self.layers = manifest, networks
        self.action_mode: str = manifest.network.action_mode
        self._network = ActNetwork(manifest.network, networks[0])
        self._state, self._observation, self._action = map(_Scaling, manifest.normalisers)
        self._indices = list(manifest.network.state)
        rate = manifest.signature.rate
        self.dt_s = self.latency_s = rate.tick_s * rate.period_ticks

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.manifest.signature.env_id}, {self.sha256[:12]})"

    @property
    def sha256(self) -> str:
        """Hash of the file of the weights: the same training gives the same one."""
        return self.manifest.weights_sha256

    def reset(self) -> None:
        """Do nothing: there is no state."""

    def chunk(self, observation: Array, time_s: float) -> Array:
        """Return a chunk of actions, (chunk_size, 12 or 14), for an observation of one cell.

        Raises:
            ActionError: Not an observation of its environment.
        """
        signature = self.manifest.signature
        given = checked_observation(observation, signature.observation.shape[0], signature.env_id)
        if given.ndim != 1:
            raise ActionError(f"a chunk is of one observation, found {len(given)} of them")
        state, seen = self._state.scaled(given[self._indices]), self._observation.scaled(given)
        found = self._action.restored(self._network(state, seen))
        if signature.actions.gripper:
            found[:, 6::7] = 2.0 * found[:, 6::7] - 1.0
        return found


class _Scaling:
    """Mean and deviation by which numbers are scaled."""

    def __init__(self, normaliser: Normaliser) -> None:
        self._mean, self._clip = np.array(normaliser.mean), normaliser.clip
        self._deviation = np.sqrt(np.array(normaliser.var) + normaliser.epsilon)

    def scaled(self, values: Array) -> Single:
        found: Single = np.clip((values - self._mean) / self._deviation, -self._clip, self._clip).astype(np.float32)
        return found

    def restored(self, values: Single) -> Array:
        found: Array = values * self._deviation + self._mean
        return found
