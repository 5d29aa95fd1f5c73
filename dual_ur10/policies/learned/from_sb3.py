"""From Stable-Baselines3's models to checkpoints: the actor's network, and what its observations are normalised by.

Stable-Baselines3 keeps models as zip files with pickles in them, which run whatever code they hold when they are read.
Beside them is JSON, which says what a model is without that.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import logging
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from dual_ur10.errors import CheckpointError, MissingExtraError, UnknownNameError
from dual_ur10.policies.learned.checkpoint import target_of
from dual_ur10.policies.learned.manifest import AgentsKind, Manifest
from dual_ur10.policies.learned.network import Activation, Layer, NetworkShape, Normaliser
from dual_ur10.policies.learned.policy import LearnedPolicy
from dual_ur10.policies.learned.signature import described, described_env

log = logging.getLogger(__name__)

Algorithm = Literal["ppo", "sac"]

_CLASSES: Final = {"ppo": "PPO", "sac": "SAC"}
_SETTINGS: Final[dict[str, Algorithm]] = {"clip_range": "ppo", "target_entropy": "sac"}  # that no other one has
_MOST_DATA: Final = 64 * 1024 * 1024  # of a model's JSON, with the last observations of some thousand cells
_ACTIVATIONS: Final[dict[str, Activation]] = {"Tanh": "tanh", "ReLU": "relu"}


def glance(path: str | os.PathLike[str]) -> tuple[Algorithm | None, int | None]:
    """What the file of a model says of itself. Only JSON in it is read: no code in it is run.

    Args:
        path: Of the zip file.

    Returns:
        What trained it, and how many numbers it observes; None: the file does not say it, or it is another algorithm.

    Raises:
        CheckpointError: It cannot be read, or is no file of Stable-Baselines3.
    """
    where = os.fspath(path)
    if not os.path.isfile(where):
        raise CheckpointError(f"{where} cannot be read: there is no such file; name a zip file of Stable-Baselines3")
    if not zipfile.is_zipfile(where):
        raise CheckpointError(f"{where} is no file of Stable-Baselines3, or is damaged: it is no zip file")
    try:
        with zipfile.ZipFile(where) as archive, archive.open("data") as stream:
            content = stream.read(_MOST_DATA + 1)
        data = json.loads(content) if len(content) <= _MOST_DATA else {}
    except Exception as error:  # zipfile raises what its parts do
        raise CheckpointError(
            f"{where} is no file of Stable-Baselines3, or is damaged: a model's has 'data' in JSON in it, found "
            f"{type(error).__name__}: {error!s:.200}"
        ) from None
    if len(content) > _MOST_DATA:
        raise CheckpointError(f"{where} has more than {_MOST_DATA} bytes of 'data' in it: no model needs so many")
    if not isinstance(data, dict) or not {"policy_class", "observation_space"} <= data.keys():
        raise CheckpointError(f"{where} is no file of Stable-Baselines3: its 'data' speaks of no model")
    algorithms = {algorithm for name, algorithm in _SETTINGS.items() if name in data}
    space = data["observation_space"]
    shape: Any = space.get("_shape") if isinstance(space, dict) else None
    size = shape[0] if isinstance(shape, list) and len(shape) == 1 and type(shape[0]) is int else None
    return algorithms.pop() if len(algorithms) == 1 else None, size


def from_sb3(
    path: str | os.PathLike[str],
    env: Any,
    *,
    algorithm: Algorithm = "ppo",
    agents: AgentsKind = "joint",
    vec_normalize: str | os.PathLike[str] | None = None,
    trust_pickle: bool = False,
    **keywords: Any,
) -> LearnedPolicy:
    """The policy of a model that Stable-Baselines3 has saved. Which environment it is for, the caller must say.

    Args:
        path: Of the zip file.
        env: The environment that it was trained in, or the id of that.
        algorithm: That trained it.
        agents: "joint" or "shared": for whom the model acts.
        vec_normalize: Path of the `VecNormalize` that was saved with it, a pickle, too; None: there is none.
        trust_pickle: The caller knows who made these files, and lets them run code.
        **keywords: As given to `gym.make`, where `env` is an id.

    Raises:
        CheckpointError: They are not to be trusted, cannot be read, or hold a network of another kind.
        MissingExtraError: Stable-Baselines3 is not installed.
        UnknownNameError: No such algorithm.
        DualUR10Error: The keywords make no environment.
    """
    if algorithm not in _CLASSES:
        raise UnknownNameError("algorithm", str(algorithm), list(_CLASSES))
    if trust_pickle is not True:
        raise CheckpointError(
            f"{os.fspath(path)} is a file of Stable-Baselines3, which runs whatever code is in it when it is read. Use "
            "a checkpoint's folder; or, if you know who made the file, make one of it: `dual-ur10 convert` does so "
            "with --trust-pickle (in Python: trust_pickle=True)"
        )
    if agents == "independent":
        raise CheckpointError("a file of Stable-Baselines3 holds one model: with agents='independent' there are two")
    try:
        kind = getattr(importlib.import_module("stable_baselines3"), _CLASSES[algorithm])
        around = importlib.import_module("stable_baselines3.common.vec_env").VecNormalize
    except ImportError:
        raise MissingExtraError("stable-baselines3", "train", "reading one of its files") from None
    place = described(env, keywords) if isinstance(env, str) else described_env(env)
    for each in (path, vec_normalize):
        if each is not None and not os.path.isfile(each):
            raise CheckpointError(f"{os.fspath(each)} cannot be read: there is no such file")
    sha256 = _read(path, lambda: hashlib.sha256(Path(path).read_bytes()).hexdigest())
    log.warning("%s (sha256 %s) may run code: you said that it is to be trusted", path, sha256)
    model = _read(path, lambda: kind.load(os.fspath(path), device="cpu"))
    normaliser = None
    if vec_normalize is not None:
        normaliser = _read(vec_normalize, lambda: pickle.loads(Path(vec_normalize).read_bytes()))
        if not isinstance(normaliser, around):
            raise CheckpointError(f"{os.fspath(vec_normalize)} holds {type(normaliser).__name__}, and no VecNormalize")
    networks, manifest = converted(
        model, env, agents=agents, vec_normalize=normaliser, training={"sb3_sha256": sha256}, **keywords
    )
    if agents == "shared" and manifest.network.layers[0] != place.agent_size:
        raise CheckpointError(
            f"{manifest.network.layers[0]} numbers go into the network: each agent of {place.target.env_id} observes "
            f"{place.agent_size}"
        )
    return LearnedPolicy(manifest, networks, place)


def converted(
    models: Any,
    env: Any,
    *,
    agents: AgentsKind = "joint",
    vec_normalize: Any = None,
    training: dict[str, object] | None = None,
    seed: int | None = None,
    evaluation: dict[str, object] | None = None,
    **keywords: Any,
) -> tuple[list[list[Layer]], Manifest]:
    """What `dual_ur10.policies.learned.checkpoint.save` takes, of models of PPO or SAC.

    Args:
        models: A model; with "independent", those of left and right.
        env: The environment that it was trained in, or the id of that.
        agents: For whom it acts.
        vec_normalize: The `VecNormalize` around its environment, or one for each model; None: there is none.
        training: Settings of the training.
        seed: Of the training.
        evaluation: What an evaluation has found.
        **keywords: As given to `gym.make`, where `env` is an id.

    Raises:
        CheckpointError: A network is of another kind, or they do not fit the environment.
    """
    each = list(models) if isinstance(models, list | tuple) else [models]
    around = list(vec_normalize) if isinstance(vec_normalize, list | tuple) else [vec_normalize]
    found = [network_of(model) for model in each]
    if len({shape for _, shape in found}) != 1:
        raise CheckpointError("the two networks look different: train them with the same settings")
    normalisers = [normaliser for one in around if (normaliser := normaliser_of(one)) is not None]
    manifest = Manifest(
        target=target_of(env, **keywords),
        agents=agents,
        network=found[0][1],
        normalisers=tuple(normalisers),
        training=dict(training or {}),
        seed=seed,
        evaluation=evaluation,
    )
    if len(each) != len(manifest.names):
        raise CheckpointError(f"there are {len(each)} models: {agents} has {len(manifest.names)}")
    return [layers for layers, _ in found], manifest


def network_of(model: Any) -> tuple[list[Layer], NetworkShape]:
    """The network by which a model of PPO or SAC acts without exploring.

    Raises:
        CheckpointError: It is of another kind.
    """
    policy = model.policy
    actor = getattr(policy, "actor", None)
    if actor is not None and hasattr(actor, "latent_pi"):
        modules, squash = [*actor.latent_pi, actor.mu], True
    elif hasattr(policy, "mlp_extractor") and hasattr(policy, "action_net"):
        modules, squash = [*policy.mlp_extractor.policy_net, policy.action_net], bool(policy.squash_output)
    else:
        raise CheckpointError(f"{type(model).__name__} has no network that is known here: use PPO or SAC, MlpPolicy")
    extractor = type((actor or policy).features_extractor).__name__
    kinds = [type(each).__name__ for each in modules]
    between = set(kinds[1::2])
    # One layer at least, and one activation, always the same.
    regular = kinds == [*["Linear", kinds[1] if between else ""] * (len(kinds) // 2), "Linear"] and len(kinds) % 2 == 1
    if extractor != "FlattenExtractor" or not regular or not between <= _ACTIVATIONS.keys():
        raise CheckpointError(
            f"the network is {extractor}, {', '.join(kinds)}: it must be FlattenExtractor and layers of Linear with "
            f"one of {', '.join(_ACTIVATIONS)} between them"
        )
    layers: list[Layer] = []
    for each in modules[::2]:
        if each.bias is None:
            raise CheckpointError("a layer of the network has no bias: it must have one")
        layers.append((_array(each.weight), _array(each.bias)))
    sizes = (layers[0][0].shape[1], *(len(bias) for _, bias in layers))
    activation = _ACTIVATIONS[min(between)] if between else "tanh"
    return layers, NetworkShape(sizes, activation, "tanh" if squash else "clip")


def normaliser_of(vec_normalize: Any) -> Normaliser | None:
    """What a `VecNormalize` does to observations; None: nothing.

    Raises:
        CheckpointError: Its observations are no plain arrays.
    """
    if vec_normalize is None or not vec_normalize.norm_obs:
        return None
    rms = vec_normalize.obs_rms
    if isinstance(rms, dict) or np.ndim(rms.mean) != 1:
        raise CheckpointError("VecNormalize is of observations with names or of images: observation must be 'state'")
    return Normaliser(
        tuple(np.asarray(rms.mean, dtype=np.float64).tolist()),
        tuple(np.asarray(rms.var, dtype=np.float64).tolist()),
        float(vec_normalize.clip_obs),
        float(vec_normalize.epsilon),
    )


def _read(path: str | os.PathLike[str], read: Callable[[], Any]) -> Any:
    try:
        return read()
    except Exception as error:  # a pickle raises what it likes
        raise CheckpointError(f"{os.fspath(path)} cannot be read: {type(error).__name__}: {error!s:.200}") from error


def _array(tensor: Any) -> Any:
    return np.array(tensor.detach().cpu().numpy(), dtype=np.float32)
