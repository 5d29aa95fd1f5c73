"""Servers of policies by their names."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from dual_ur10.errors import SettingsError
from dual_ur10.ids import __version__
from dual_ur10.policies.chunks.executor import ChunkExecutor
from dual_ur10.policies.learned.checkpoint import read_manifest
from dual_ur10.policies.learned.signature import view_of_signature
from dual_ur10.policies.registry import is_path, keywords_for, load, setup_of
from dual_ur10.policies.remote.policy_server import PolicyServer


def server_of(
    policy: str,
    env_id: str | None = None,
    keywords: Mapping[str, Any] = MappingProxyType({}),
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    token: str | None = None,
) -> PolicyServer:
    """Return the server of a policy, for an environment with these keywords.

    Args:
        policy: As for `dual_ur10.policies.load`; a "module:Class" may be of a chunk policy.
        env_id: Id of the environment; None: that of a checkpoint.
        keywords: Keywords of the environment.
        host: As for `PolicyServer`.
        port: Likewise.
        token: Likewise.

    Raises:
        DualUR10Error: The policy cannot be loaded, or the address cannot be served.
    """
    if env_id is None:
        if not is_path(policy):
            raise SettingsError(f"policy {policy!r:.80} needs an environment: name it with --env, such as SineTracking")
        signature = read_manifest(policy).signature
        view_of_signature(signature)  # what it names is not imported; below, what `keywords` name is
        env_id, keywords = signature.env_id, {**signature.kwargs, **keywords}
    keywords = keywords_for(policy, env_id, dict(keywords))
    actor: Any = load(policy, env_id, **keywords)
    setup = setup_of(env_id, keywords)
    metadata: dict[str, Any] = {
        "server": f"dual_ur10 {__version__}",
        "policy": policy,
        "env_id": setup.env_id,
        "keywords": {name: getattr(setup.options, name) for name in ("action_mode", "action_scale", "observation")},
        "endpoints": ["infer", "reset"],
        "time_key": "time_s",
    }
    if isinstance(actor, ChunkExecutor):
        actor = actor.source
        metadata |= {"dt_s": actor.dt_s, "action_space": actor.action_mode}
    else:
        metadata |= {
            "dt_s": setup.timing.period_s,
            "action_space": setup.options.action_mode,
            "action_horizon": 1,
        }
    return PolicyServer(actor, metadata, host=host, port=port, token=token)
