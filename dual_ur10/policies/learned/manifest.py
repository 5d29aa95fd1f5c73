"""Manifest of a checkpoint: its environment, its networks and its origin."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from pydantic import Discriminator, Tag

from dual_ur10.errors import CheckpointError, DualUR10Error
from dual_ur10.policies.chunks.chunk_policy import CHUNK_MODES
from dual_ur10.policies.learned import schema
from dual_ur10.policies.learned.act_network import ActShape
from dual_ur10.policies.learned.network import NetworkShape, Normaliser
from dual_ur10.policies.learned.schema import JsonList, Object, StrictJson, Text, Whole
from dual_ur10.policies.learned.signature import EnvironmentSignature
from dual_ur10.sim2real.recording.header import plain
from dual_ur10.sim2real.recording.header import versions as installed
from ur_core.kinematics.ur10 import ARMS

FORMAT: Final = "dual-ur10 policy 1"

AgentsKind = Literal["joint", "shared", "independent"]
"""One network for both arms together; the same one for each arm by itself; or one of its own for each arm."""

_MOST_COMMAS: Final = 1 << 16
"""Bound of the number of values: a wrong one takes about 1.5 KB for its finding. Legal manifests have half as many."""

_PACKAGES: Final = ("numpy", "gymnasium", "mujoco", "safetensors", "torch", "stable_baselines3")
_VERSION: Final = r"^(0|[1-9][0-9]{0,5})\.(0|[1-9][0-9]{0,5})[0-9A-Za-z.+-]{0,40}$"


def versions() -> dict[str, str]:
    """Return the versions of this package and of those that a policy is made with, as far as they are installed."""
    return installed(*_PACKAGES)


def _kind_of(network: object) -> str:
    is_act = isinstance(network, ActShape) or (isinstance(network, dict) and "chunk_size" in network)
    return "transformer" if is_act else "dense"


@dataclass(frozen=True, kw_only=True)
class Manifest(StrictJson):
    """Everything in a checkpoint but the weights.

    Attributes:
        signature: Environment that the policy was made for.
        agents: Number of networks, and the arms that each one moves.
        network: Shape of each network. An ACT is one network for both arms.
        normalisers: One for each network, or () if observations enter as they are. Of an ACT those of each of its
            `inputs`, the positions of both arms and the observation, and of an action.
        training: Settings of the training, any JSON object.
        seed: Seed of the training; None: it had none.
        evaluation: Results of an evaluation, any JSON object; None: there was none.
        versions: Versions of this package and others.
        weights_sha256: Hash of the file of the weights; "" until it is saved.

    Raises:
        CheckpointError: The parts do not fit each other.
    """

    signature: EnvironmentSignature
    agents: AgentsKind
    network: Annotated[
        Annotated[NetworkShape, Tag("dense")] | Annotated[ActShape, Tag("transformer")], Discriminator(_kind_of)
    ]
    normalisers: Annotated[tuple[Normaliser, ...], JsonList] = ()
    training: Object = dataclasses.field(default_factory=dict)
    seed: Whole | None = None
    evaluation: Object | None = None
    versions: dict[Text, Text] = dataclasses.field(default_factory=versions)
    weights_sha256: Text = ""

    def __post_init__(self) -> None:
        if isinstance(self.network, ActShape):
            self._check_act(self.network)
        else:
            self._check_layers(self.network)
        for name, value, pattern, allowed in (
            ("dual_ur10 in versions", self.versions.get("dual_ur10", ""), _VERSION, "a version such as 1.2.3"),
            ("weights_sha256", self.weights_sha256, r"^([0-9a-f]{64})?$", "64 digits, 0 to f"),
        ):
            if not re.fullmatch(pattern, value, re.ASCII):
                raise CheckpointError(f"{name} is {value!r:.80}: it must be {allowed}")

    def _check_layers(self, network: NetworkShape) -> None:
        inputs, outputs = network.layers[0], network.layers[-1]
        if self.normalisers and len(self.normalisers) != len(self.names):
            raise CheckpointError(
                f"there are {len(self.normalisers)} normalisers for {len(self.names)} networks: one each, or none"
            )
        for each in self.normalisers:
            if len(each.mean) != inputs:
                raise CheckpointError(f"a normaliser has {len(each.mean)} means for {inputs} inputs of the network")
        arms = 1 if self.agents == "joint" else 2
        wanted, given = self.signature.action.shape[0] // arms, self.signature.observation.shape[0] // arms
        if outputs != wanted:
            raise CheckpointError(f"the network has {outputs} outputs: {self.agents} actions have {wanted} numbers")
        if inputs != given:
            raise CheckpointError(f"the network has {inputs} inputs: {self.agents} observations have {given} numbers")

    def _check_act(self, network: ActShape) -> None:
        if self.agents != "joint":
            raise CheckpointError(f"agents is {self.agents!r}: an ACT is one network for both arms, 'joint'")
        if self.signature.actions.mode not in CHUNK_MODES:
            raise CheckpointError(
                f"actions.mode is {self.signature.actions.mode!r}: an ACT is for {' and '.join(CHUNK_MODES)}"
            )
        if (self.signature.view == "both") != bool(network.cameras):
            raise CheckpointError(
                f"view is {self.signature.view!r}, and the network sees images of {len(network.cameras)} cameras: "
                "'both' has some"
            )
        size = self.signature.observation.shape[0]
        found = network.environment_state or size, network.action
        wanted = size, self.signature.action.shape[0]
        if found != wanted:
            raise CheckpointError(f"the network is of observations and actions of {found} numbers: they have {wanted}")
        if max(network.state) >= size:
            raise CheckpointError(f"state is {network.state!r:.80}: the indices of an observation are 0 to {size - 1}")
        sizes = [len(each.mean) for each in self.normalisers]
        expected = [*network.inputs.values(), network.action]
        if sizes != expected:
            raise CheckpointError(f"the normalisers have {sizes} means: those of an ACT have {expected}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the networks, in the file of the weights."""
        if isinstance(self.network, ActShape):
            return ("model",)  # as LeRobot has it
        return ARMS if self.agents == "independent" else ("policy",)

    def text(self) -> str:
        """Return the content of the file, with a checksum over all of it.

        Raises:
            CheckpointError: A value in it cannot be written as JSON, or would be refused when it is read.
        """
        try:
            value = {"format": FORMAT, **plain(dataclasses.asdict(self))}  # NumPy's arrays become lists, too
            text = json.dumps({**value, "sha256": _checksum(value)}, indent=1, ensure_ascii=False)
        except DualUR10Error as error:
            raise CheckpointError(f"the manifest cannot be written: {error}") from None
        parse(text.encode(), "manifest")
        return text + "\n"


def parse(text: bytes, where: str = "manifest.json") -> Manifest:
    """Return the manifest in a text.

    Raises:
        CheckpointError: It is not as this version writes it, or was changed since.
    """
    if (commas := text.count(b",")) > _MOST_COMMAS:
        raise CheckpointError(f"{where} has {commas} commas: at most {_MOST_COMMAS} values are read")
    value = schema.loads(text, where)
    if not isinstance(value, dict):
        raise CheckpointError(f"{where} is no JSON object")
    if value.pop("format", None) != FORMAT:
        raise CheckpointError(f"{where} is not of format {FORMAT!r}: this version reads no other")
    checksum = value.pop("sha256", None)
    if checksum != _checksum({"format": FORMAT, **value}):
        raise CheckpointError(f"{where} has been changed since it was saved, or is damaged: its checksum is another")
    return schema.read(Manifest, value, where)


def _checksum(value: dict[str, Any]) -> str:
    """Return the hash of the content, whatever its layout."""
    try:
        text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"the manifest cannot be read: {error!s:.200}") from None
    return hashlib.sha256(text.encode()).hexdigest()
