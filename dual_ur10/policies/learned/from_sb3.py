"""Conversion of Stable-Baselines3's models to checkpoints: the actor's network and the normaliser of its observations.

Stable-Baselines3 saves models as zip files with pickles, which run whatever code they hold when they are read. JSON
beside the pickles describes the model without running any.
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
from dual_ur10.policies.learned.checkpoint import signature_of
from dual_ur10.policies.learned.learned_policy import LearnedPolicy
from dual_ur10.policies.learned.manifest import AgentsKind, Manifest
from dual_ur10.policies.learned.network import Activation, Layer, NetworkShape, Normaliser

log = logging.getLogger(__name__)

Algorithm = Literal["ppo", "sac"]

_CLASSES: Final = {"ppo": "PPO", "sac": "SAC"}
_SETTINGS: Final[dict[str, Algorithm]] = {
    "clip_range": "ppo",
    "target_entropy": "sac",
}  # unique to each
_MOST_DATA: Final = 64 * 1024 * 1024  # bytes of a model's JSON, with the last observations of thousands of cells
_ACTIVATIONS: Final[dict[str, Activation]] = {"Tanh": "tanh", "ReLU": "relu"}


def inspect_model(path: str | os.PathLike[str]) -> tuple[Algorithm | None, int | None]:
    """Return the algorithm and the observation size of a model's file. Only its JSON is read: no code is run.

    Args:
        path: Path of the zip file.

    Returns:
        Algorithm and observation size; None for what the file does not state, or for another algorithm.

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
        raise CheckpointError(f"{where} is no file of Stable-Baselines3: its 'data' describes no model")
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
    """Load the policy of a model that Stable-Baselines3 has saved. The file does not name its environment.

    Args:
        path: Path of the zip file.
        env: Environment that it was trained in, or the id of that.
        algorithm: Algorithm that trained it.
        agents: "joint" or "shared": the arms that the model moves.
        vec_normalize: Path of the `VecNormalize` that was saved with it, also a pickle; None: there is none.
        trust_pickle: True if you know who made these files and allow them to run code.
        **keywords: As for `gym.make`, where `env` is an id.

    Raises:
        CheckpointError: The files are not trusted, cannot be read, or hold a network of another kind.
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
    return LearnedPolicy(manifest, networks)


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
    """Convert models of PPO or SAC to the arguments of `dual_ur10.policies.learned.checkpoint.save`.

    Args:
        models: A model; with "independent", those of left and right.
        env: Environment that it was trained in, or the id of that.
        agents: Arms that a model moves.
        vec_normalize: `VecNormalize` around its environment, or one for each model; None: there is none.
        training: Settings of the training.
        seed: Seed of the training.
        evaluation: Results of an evaluation.
        **keywords: As for `gym.make`, where `env` is an id.

    Raises:
        CheckpointError: A network is of another kind, or it or its actions do not fit the environment.
    """
    each = list(models) if isinstance(models, list | tuple) else [models]
    around = list(vec_normalize) if isinstance(vec_normalize, list | tuple) else [vec_normalize]
    found = [network_of(model) for model in each]
    if len({shape for _, shape in found}) != 1:
        raise CheckpointError("the two networks look different: train them with the same settings")
    trained_in = [model.get_vec_normalize_env() for model in each]
    if vec_normalize is None and any(normaliser_of(one) is not None for one in trained_in):
        raise CheckpointError(
            "the model was trained on normalised observations, and vec_normalize is None: pass the VecNormalize, which "
            "is model.get_vec_normalize_env()"
        )
    normalisers = [normaliser for one in around if (normaliser := normaliser_of(one)) is not None]
    manifest = Manifest(
        signature=signature_of(env, **keywords),
        agents=agents,
        network=found[0][1],
        normalisers=tuple(normalisers),
        training=dict(training or {}),
        seed=seed,
        evaluation=evaluation,
    )
    if len(each) != len(manifest.names):
        raise CheckpointError(f"there are {len(each)} models: {agents} has {len(manifest.names)}")
    for bound in ("low", "high"):
        stated = np.array(getattr(manifest.signature.action, bound), dtype=np.float32)
        # "shared" states the action of one arm.
        learned = np.resize(np.concatenate([getattr(model.action_space, bound) for model in each]), stated.shape)
        if not np.allclose(learned, stated):
            raise CheckpointError(
                f"{bound} of the model's actions is {learned.tolist()!r:.80}, the environment's is "
                f"{stated.tolist()!r:.80}: pass the keywords of its training, such as action_mode"
            )
    return [layers for layers, _ in found], manifest


def network_of(model: Any) -> tuple[list[Layer], NetworkShape]:
    """Return the network by which a model of PPO or SAC acts without exploring.

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
        raise CheckpointError(f"{type(model).__name__} has an unknown kind of network: use PPO or SAC, MlpPolicy")
    extractor = type((actor or policy).features_extractor).__name__
    kinds = [type(each).__name__ for each in modules]
    between = set(kinds[1::2])
    # At least one layer, and the same activation after each.
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
    """Return the normaliser of observations of a `VecNormalize`; None: it leaves them as they are.

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
    except Exception as error:  # a pickle may raise anything
        raise CheckpointError(f"{os.fspath(path)} cannot be read: {type(error).__name__}: {error!s:.200}") from error


def _array(tensor: Any) -> Any:
    return np.array(tensor.detach().cpu().numpy(), dtype=np.float32)
