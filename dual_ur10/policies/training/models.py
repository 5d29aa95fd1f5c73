"""Models of Stable-Baselines3: construction from settings, initialisation from a checkpoint, conversion to tensors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dual_ur10.envs.api.sb3_bridge import RewardDifferences, hide, scale
from dual_ur10.errors import MissingExtraError, TrainingError
from dual_ur10.policies.learned.learned_policy import LearnedPolicy
from dual_ur10.policies.training.settings import Reinforcement
from dual_ur10.policies.training.state import Tensors

try:
    import torch
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize
except ImportError as error:
    raise MissingExtraError("stable-baselines3", "train", "training") from error

_EXPLORED: float = 0.9  # of the training, after which exploration does not change
_NORMAL_ENTROPY: float = 0.5 * math.log(2.0 * math.pi * math.e)  # of a standard deviation of 1
_FIRST_ENTROPY_WEIGHT: float = 0.01  # of SAC, which learns it: with 1 noise would be worth more than reward
_NEAR_ZERO: float = 0.01  # times the weights of an untrained head, as Stable-Baselines3 has it for PPO
_SURE: float = 1e7  # weight of a checkpoint's normaliser, in observations: it hardly changes any more


def make(
    algorithm: str,
    env: VecEnv,
    settings: Reinforcement,
    seed: int,
    share: Callable[[], float] = lambda: 0.0,
    unseen: Sequence[int] = (),
) -> tuple[Any, VecNormalize]:
    """Return a model, and the normaliser around its environment.

    Args:
        algorithm: "ppo" or "sac".
        env: Vector environment of one learner.
        settings: Settings of the algorithm.
        seed: Seed of the model.
        share: Function that returns the ratio of the training's steps that are done.
        unseen: Indices of the values of an observation that the policy does not see.
    """
    monitored: VecEnv = VecMonitor(env)
    if settings.differences:
        monitored = RewardDifferences(monitored, settings.gamma, lambda: settings.refusals * share())
    around = VecNormalize(monitored, gamma=settings.gamma, norm_reward=algorithm == "ppo")
    if not settings.scaled:
        scale(around, unseen)
    if algorithm == "ppo":
        model: Any = _ppo(around, settings, seed, share)
    else:
        model = _sac(around, settings, seed, share)
    hide(model, unseen)
    return model, around


def _ppo(env: VecEnv, settings: Reinforcement, seed: int, share: Callable[[], float]) -> PPO:
    hidden = list(settings.hidden)
    return PPO(
        "MlpPolicy",
        env,
        learning_rate=lambda _: settings.learning_rate * (1.0 - share()),
        n_steps=settings.steps_per_update,
        batch_size=min(settings.batch_size, settings.steps_per_update * env.num_envs),
        n_epochs=settings.epochs,
        gamma=settings.gamma,
        gae_lambda=settings.gae_lambda,
        clip_range=settings.clip_range,
        ent_coef=settings.entropy,
        target_kl=settings.target_kl,
        policy_kwargs={
            "net_arch": {"pi": hidden, "vf": hidden},
            "log_std_init": float(np.log(settings.first_std)),
        },
        seed=seed,
        device="cpu",
    )


def _sac(env: VecEnv, settings: Reinforcement, seed: int, share: Callable[[], float]) -> Any:
    hidden = list(settings.hidden)
    model: Any = SAC(
        "MlpPolicy",
        env,
        learning_rate=lambda _: settings.learning_rate * (1.0 - share()),
        gamma=settings.gamma,
        batch_size=settings.batch_size,
        buffer_size=settings.buffer_size,
        learning_starts=settings.learning_starts,
        train_freq=1,
        gradient_steps=settings.gradient_steps,
        ent_coef=f"auto_{_FIRST_ENTROPY_WEIGHT}",
        policy_kwargs={"net_arch": {"pi": hidden, "qf": hidden}},
        seed=seed,
        device="cpu",
    )
    # It begins as PPO does: near zero, and as wide. Untrained heads would act at random, in all of the range.
    with torch.no_grad():
        for head, bias in ((model.actor.mu, 0.0), (model.actor.log_std, math.log(settings.first_std))):
            head.weight.mul_(_NEAR_ZERO)
            head.bias.fill_(bias)
    return model


def explore(model: Any, settings: Reinforcement, share: float, grippers: int) -> None:
    """Set the width of exploration, and if PPO's actions may change, for this ratio of the training's steps.

    Args:
        model: Model of Stable-Baselines3. PPO acts with the standard deviation of `Reinforcement`, SAC aims at the
            entropy of a normal distribution with it.
        settings: Settings of the algorithm.
        share: Ratio of the training's steps that are done.
        grippers: Size of an arm's action, which ends with that of its gripper; 0: there are none.
    """
    ratio = settings.last_std / settings.first_std
    width = math.log(settings.first_std * ratio ** min(1.0, share / _EXPLORED))
    log_std = torch.full(model.action_space.shape, width)
    if grippers:
        log_std[grippers - 1 :: grippers] += math.log(settings.gripper_std)
    if isinstance(model, PPO):
        for part in (model.policy.mlp_extractor.policy_net, model.policy.action_net):
            part.requires_grad_(share >= settings.critic_first)
        std: Any = model.policy.log_std
        std.requires_grad_(False)
        std.copy_(log_std)
    else:
        model.target_entropy = float(log_std.sum()) + _NORMAL_ENTROPY * len(log_std)


def begin_with(models: list[tuple[Any, VecNormalize]], policy: LearnedPolicy) -> None:
    """Initialise the policies of PPO's models, not their value functions, with the networks of a checkpoint."""
    normalisers = policy.manifest.normalisers or (None,) * len(models)
    for (model, around), layers, normaliser in zip(models, policy.layers, normalisers, strict=True):
        modules = [each for each in model.policy.mlp_extractor.policy_net if isinstance(each, torch.nn.Linear)]
        with torch.no_grad():
            for module, (weight, bias) in zip([*modules, model.policy.action_net], layers, strict=True):
                module.weight.copy_(torch.from_numpy(np.array(weight)))
                module.bias.copy_(torch.from_numpy(np.array(bias)))
        if normaliser is None:
            around.norm_obs = False
            continue
        rms: Any = around.obs_rms
        rms.mean, rms.var, rms.count = np.array(normaliser.mean), np.array(normaliser.var), _SURE
        around.clip_obs, around.epsilon = normaliser.clip, normaliser.epsilon


def tensors_of(model: Any, around: VecNormalize, prefix: str) -> Tensors:
    """Return all numbers of a model, its optimizers and its normaliser, by names that begin with a prefix.

    SAC's replay buffer is not among them: it is too large, and is collected anew.
    """
    result: Tensors = {}
    for name, values in model.get_parameters().items():
        _flatten(values, f"{prefix}{name}", result)
    for name in model._get_torch_save_params()[1]:
        value = getattr(model, name)
        if isinstance(value, torch.Tensor):
            result[f"{prefix}variable.{name}"] = np.array(value.detach().numpy())
    around_as: Any = (around.norm_obs, around.clip_obs, around.epsilon)  # `begin_with` sets them
    result[f"{prefix}normaliser"] = np.array(around_as, dtype=np.float64)
    rms: Any
    for name, rms in (("obs", around.obs_rms), ("ret", around.ret_rms)):
        for part in ("mean", "var", "count"):
            result[f"{prefix}{name}_rms.{part}"] = np.array(getattr(rms, part), dtype=np.float64)
    return result


def restore(model: Any, around: VecNormalize, prefix: str, tensors: Tensors) -> None:
    """Restore the numbers of a model that was made with the same settings.

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
        seen, clip, epsilon = tensors[f"{prefix}normaliser"].tolist()
        around.norm_obs, around.clip_obs, around.epsilon = bool(seen), clip, epsilon
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
            if key != "param_groups":  # the new model has these settings
                _flatten(each, f"{name}/{key}", into)


def _filled(value: Any, name: str, tensors: Tensors) -> Any:
    """Return a copy of `value` with the numbers of these tensors. A new optimizer has no numbers yet."""
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
