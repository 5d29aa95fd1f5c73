"""Models of Stable-Baselines3: made with a training's settings, begun with a checkpoint, kept as numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from dual_ur10.errors import MissingExtraError, TrainingError
from dual_ur10.policies.learned import LearnedPolicy
from dual_ur10.policies.network import Layer, Normaliser
from dual_ur10.training.settings import Reinforcement
from dual_ur10.training.state import Tensors

try:
    import torch
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize
except ImportError as error:
    raise MissingExtraError("stable-baselines3", "train", "training") from error

_SURE: float = 1e7  # observations that the normaliser of a checkpoint stands for: it hardly moves any more


def make(algorithm: str, env: VecEnv, settings: Reinforcement, seed: int) -> tuple[Any, VecNormalize]:
    """A model, and the normaliser around its environment."""
    around = VecNormalize(VecMonitor(env), gamma=settings.gamma, norm_reward=algorithm == "ppo")
    hidden = list(settings.hidden)
    if algorithm == "ppo":
        model: Any = PPO(
            "MlpPolicy",
            around,
            learning_rate=settings.learning_rate,
            n_steps=settings.steps_per_update,
            batch_size=min(settings.batch_size, settings.steps_per_update * env.num_envs),
            n_epochs=settings.epochs,
            gamma=settings.gamma,
            gae_lambda=settings.gae_lambda,
            clip_range=settings.clip_range,
            ent_coef=settings.entropy,
            policy_kwargs={
                "net_arch": {"pi": hidden, "vf": hidden},
                "log_std_init": float(np.log(settings.first_std)),
            },
            seed=seed,
            device="cpu",
        )
    else:
        model = SAC(
            "MlpPolicy",
            around,
            learning_rate=settings.learning_rate,
            gamma=settings.gamma,
            batch_size=settings.batch_size,
            buffer_size=settings.buffer_size,
            learning_starts=settings.learning_starts,
            train_freq=1,
            gradient_steps=settings.gradient_steps,
            policy_kwargs={"net_arch": {"pi": hidden, "qf": hidden}},
            seed=seed,
            device="cpu",
        )
    return model, around


def begin_with(models: list[tuple[Any, VecNormalize]], policy: LearnedPolicy) -> None:
    """Begin with the networks of a checkpoint: what acts, not what judges.

    Raises:
        TrainingError: Its networks are others.
    """
    networks = list(policy.layers)
    normalisers = policy.manifest.normalisers or (None,) * len(networks)
    if len(networks) != len(models):
        raise TrainingError(
            f"the checkpoint has {len(networks)} networks for {len(models)} models: agents must be equal"
        )
    for (model, around), layers, normaliser in zip(models, networks, normalisers, strict=True):
        _begin_with(model, around, layers, normaliser, policy.manifest.network.activation)


def _begin_with(model: Any, around: VecNormalize, layers: Any, normaliser: Normaliser | None, activation: str) -> None:
    if not isinstance(model, PPO):
        raise TrainingError("only PPO can begin with a checkpoint: SAC's network has another form")
    modules: list[Any] = [each for each in model.policy.mlp_extractor.policy_net if isinstance(each, torch.nn.Linear)]
    modules.append(model.policy.action_net)
    given: list[Layer] = list(layers)
    if activation != "tanh" or [tuple(each.weight.shape) for each in modules] != [w.shape for w, _ in given]:
        raise TrainingError(
            f"the checkpoint has {activation} layers of {[w.shape for w, _ in given]}, this training has tanh layers "
            f"of {[tuple(each.weight.shape) for each in modules]}"
        )
    with torch.no_grad():
        for module, (weight, bias) in zip(modules, given, strict=True):
            module.weight.copy_(torch.from_numpy(np.array(weight)))
            module.bias.copy_(torch.from_numpy(np.array(bias)))
    if normaliser is None:
        around.norm_obs = False
        return
    rms: Any = around.obs_rms
    rms.mean, rms.var, rms.count = np.array(normaliser.mean), np.array(normaliser.var), _SURE
    around.clip_obs, around.epsilon = normaliser.clip, normaliser.epsilon


def tensors_of(model: Any, around: VecNormalize, prefix: str) -> Tensors:
    """All numbers of a model, its optimizers and its normaliser, by names that begin with a prefix.

    SAC's memory of transitions is not among them: it is too large, and is gathered anew.
    """
    result: Tensors = {}
    for name, values in model.get_parameters().items():
        _flatten(values, f"{prefix}{name}", result)
    for name in model._get_torch_save_params()[1]:
        value = getattr(model, name)
        if isinstance(value, torch.Tensor):
            result[f"{prefix}variable.{name}"] = np.array(value.detach().numpy())
    rms: Any
    for name, rms in (("obs", around.obs_rms), ("ret", around.ret_rms)):
        for part in ("mean", "var", "count"):
            result[f"{prefix}{name}_rms.{part}"] = np.array(getattr(rms, part), dtype=np.float64)
    return result


def restore(model: Any, around: VecNormalize, prefix: str, tensors: Tensors) -> None:
    """Give a model that was made alike these numbers.

    Raises:
        TrainingError: They are of another model.
    """
    try:
        parameters: dict[str, Any] = {}
        for name, values in model.get_parameters().items():
            parameters[name] = _filled(values, f"{prefix}{name}", tensors)
        model.set_parameters(parameters)
        for name in model._get_torch_save_params()[1]:
            value = getattr(model, name)
            if isinstance(value, torch.Tensor):
                with torch.no_grad():
                    value.copy_(torch.from_numpy(tensors[f"{prefix}variable.{name}"]))
        rms: Any
        for name, rms in (("obs", around.obs_rms), ("ret", around.ret_rms)):
            for part in ("mean", "var", "count"):
                found = tensors[f"{prefix}{name}_rms.{part}"]
                setattr(rms, part, float(found) if part == "count" else np.array(found))
    except (KeyError, ValueError, RuntimeError) as error:
        raise TrainingError(f"the state is not of this training: {type(error).__name__}: {error!s:.200}") from error


def _flatten(value: Any, name: str, into: Tensors) -> None:
    if isinstance(value, torch.Tensor):
        into[name] = np.array(value.detach().numpy())
    elif isinstance(value, dict):
        for key, each in value.items():
            if key != "param_groups":  # settings, which the new model has
                _flatten(each, f"{name}/{key}", into)


def _filled(value: Any, name: str, tensors: Tensors) -> Any:
    """As `value`, with the numbers of these tensors. An optimizer that is new has no numbers yet."""
    if isinstance(value, torch.Tensor):
        found = torch.from_numpy(tensors[name])
        if found.shape != value.shape:
            raise ValueError(f"{name} has shape {tuple(found.shape)}, expected {tuple(value.shape)}")
        return found
    result = {}
    for key, each in value.items():
        if key == "state":
            result[key] = _optimizer_state(f"{name}/{key}/", tensors)
        else:
            result[key] = _filled(each, f"{name}/{key}", tensors) if isinstance(each, dict | torch.Tensor) else each
    return result


def _optimizer_state(prefix: str, tensors: Tensors) -> dict[int, dict[str, Any]]:
    result: dict[int, dict[str, Any]] = {}
    for name, value in tensors.items():
        if name.startswith(prefix):
            index, key = name.removeprefix(prefix).split("/")
            result.setdefault(int(index), {})[key] = torch.from_numpy(value)
    return result
