"""What a checkpoint says of itself: what it was made for, what its network looks like and where it comes from."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from dataclasses import dataclass
from typing import Any, Final, Literal

from dual_ur10.errors import CheckpointError, DualUR10Error
from dual_ur10.kinematics.ur10 import ARMS
from dual_ur10.policies.learned import schema
from dual_ur10.policies.learned.network import NetworkShape, Normaliser
from dual_ur10.policies.learned.signature import Target
from dual_ur10.sim2real.recording.describe import plain
from dual_ur10.sim2real.recording.describe import versions as installed

FORMAT: Final = "dual-ur10 policy 1"

AgentsKind = Literal["joint", "shared", "independent"]
"""One network for both arms together; the same one for each arm by itself; or one of its own for each arm."""

_PACKAGES: Final = ("numpy", "gymnasium", "mujoco", "safetensors", "torch", "stable_baselines3")
_HASH: Final = re.compile(r"[0-9a-f]{64}", re.ASCII)
_VERSION: Final = re.compile(r"(0|[1-9][0-9]{0,5})\.(0|[1-9][0-9]{0,5})[0-9A-Za-z.+-]{0,40}", re.ASCII)


def versions() -> dict[str, str]:
    """Versions of this package and of those that a policy is made with, as far as they are installed."""
    return installed(*_PACKAGES)


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What a checkpoint says of itself.

    Attributes:
        target: The environment that it was made for.
        agents: How many networks there are, and whose.
        network: What they look like.
        normalisers: One for each network, or () if observations go in as they are.
        training: Settings of the training, anything that JSON holds.
        seed: Of the training; None: it had none.
        evaluation: What an evaluation has found, anything that JSON holds; None: there was none.
        versions: Of this package and others.
        weights_sha256: Of the file of the weights; "" until it is saved.

    Raises:
        CheckpointError: The parts do not fit each other.
    """

    target: Target
    agents: AgentsKind
    network: NetworkShape
    normalisers: tuple[Normaliser, ...] = ()
    training: dict[str, object] = dataclasses.field(default_factory=dict)
    seed: int | None = None
    evaluation: dict[str, object] | None = None
    versions: dict[str, str] = dataclasses.field(default_factory=versions)
    weights_sha256: str = ""

    def __post_init__(self) -> None:
        inputs, outputs = self.network.layers[0], self.network.layers[-1]
        if self.normalisers and len(self.normalisers) != len(self.names):
            raise CheckpointError(
                f"there are {len(self.normalisers)} normalisers for {len(self.names)} networks: one each, or none"
            )
        for each in self.normalisers:
            if len(each.mean) != inputs:
                raise CheckpointError(f"a normaliser has {len(each.mean)} means for {inputs} numbers that go in")
        wanted = self.target.action.shape[0] // (1 if self.agents == "joint" else 2)
        if outputs != wanted:
            raise CheckpointError(f"{outputs} numbers come out of the network: {self.agents} actions have {wanted}")
        if self.agents == "joint" and inputs != self.target.observation.shape[0]:
            raise CheckpointError(
                f"{inputs} numbers go into the network: observations have {self.target.observation.shape[0]}"
            )
        if not _VERSION.fullmatch(self.versions.get("dual_ur10", "")):
            raise CheckpointError(f"versions has dual_ur10 {self.versions.get('dual_ur10')!r:.60}: it must be as 1.2.3")
        if self.weights_sha256 and not _HASH.fullmatch(self.weights_sha256):
            raise CheckpointError(f"weights_sha256 is {self.weights_sha256!r:.80}: it must be 64 digits, 0 to f")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the networks, in the file of the weights."""
        return ARMS if self.agents == "independent" else ("policy",)

    def text(self) -> str:
        """As the file says it, with a checksum over all of it.

        Raises:
            CheckpointError: Something in it cannot be said in JSON.
        """
        try:
            given = plain(dataclasses.asdict(self))  # turns arrays of numpy into lists, too
        except DualUR10Error as error:
            raise CheckpointError(f"the manifest cannot be written: {error}") from None
        value = schema.plain({"format": FORMAT, **given}, "manifest")
        text = json.dumps({**value, "sha256": _checksum(value)}, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        parse(text.encode())  # what could not be read is refused now and not later
        return text


def parse(text: bytes, where: str = "manifest.json") -> Manifest:
    """What a manifest's text says.

    Raises:
        CheckpointError: It is not as this version writes it, or was changed since.
    """
    value = schema.parsed(text, where)
    if not isinstance(value, dict):
        raise CheckpointError(f"{where} is no JSON object")
    if value.pop("format", None) != FORMAT:
        raise CheckpointError(f"{where} is not of format {FORMAT!r}: this version reads no other")
    checksum = value.pop("sha256", None)
    if checksum != _checksum({"format": FORMAT, **value}):
        raise CheckpointError(f"{where} has been changed since it was saved, or is damaged: its checksum is another")
    return schema.read(Manifest, value, where)


def _checksum(value: dict[str, Any]) -> str:
    """Of the content, not of its layout."""
    try:
        text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"the manifest cannot be read: {error!s:.200}") from None
    return hashlib.sha256(text.encode()).hexdigest()
