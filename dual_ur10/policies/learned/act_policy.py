"""Learned chunk policies: a transformer, and the actions that its outputs stand for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
        stateless: Rows of a batch may ask it in turn.

    Raises:
        CheckpointError: The network is another.
        MissingExtraError: It sees images, and PyTorch is not installed.
    """

    portable = stateless = True

    def __init__(self, manifest: Manifest, networks: Sequence[ActTensors]) -> None:
        if not isinstance(manifest.network, ActShape):
            raise CheckpointError("the network returns no chunks: it is no ACT")
        self.manifest, self.layers = manifest, networks
        self.action_mode: str = manifest.network.action_mode
        self._network: Any
        if manifest.network.cameras:
            from dual_ur10.policies.learned.act_torch import ActImageNetwork  # needs PyTorch

            self._network = ActImageNetwork(manifest.network, networks[0])
        else:
            self._network = ActNetwork(manifest.network, networks[0])
        *self._inputs, self._action = map(_Scaling, manifest.normalisers)
        self._shape = manifest.network
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

    def chunk(self, observation: Any, time_s: float) -> Array:
        """Return a chunk of actions, (chunk_size, 12 or 14), for an observation of one cell.

        Args:
            observation: (O,) numbers; with cameras `{"state": numbers, "pixels": {camera: image}}`.
            time_s: Not used.

        Raises:
            ActionError: Not an observation of its environment.
        """
        signature, images = self.manifest.signature, list[Any]()
        if self._shape.cameras:
            observation, images = self._split(observation)
        given = checked_observation(observation, signature.observation.shape[0], signature.env_id)
        if given.ndim != 1:
            raise ActionError(f"a chunk is of one observation, found {len(given)} of them")
        values = (given[list(self._shape.state)], given)[: len(self._inputs)]
        inputs = [each.scaled(value) for each, value in zip(self._inputs, values, strict=True)]
        found = self._action.restored(self._network(*inputs, *images))
        if signature.actions.gripper:
            found[:, 6::7] = 2.0 * found[:, 6::7] - 1.0
        return found

    def _split(self, observation: Any) -> tuple[Any, list[NDArray[np.uint8]]]:
        """Return the numbers of an observation, and its images, (cameras, height, width, 3).

        Raises:
            ActionError: It lacks one of them, or an image has another size.
        """
        names, size = self._shape.cameras, (self._shape.height, self._shape.width, 3)
        pixels = observation.get("pixels") if isinstance(observation, Mapping) else None
        if not isinstance(pixels, Mapping) or "state" not in observation or not {*names} <= {*pixels}:
            raise ActionError(
                f"an observation of {self.manifest.signature.env_id} has `state` and, in `pixels`, images of "
                f"{', '.join(names)}: make the environment with observation='both' and these cameras"
            )
        images = [np.asarray(pixels[each]) for each in names]
        for name, each in zip(names, images, strict=True):
            if each.dtype != np.uint8 or each.shape != size:
                raise ActionError(
                    f"the image of {name} is {each.dtype} of shape {each.shape}: it must be uint8 of {size}"
                )
        return observation["state"], [np.stack(images)]


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
