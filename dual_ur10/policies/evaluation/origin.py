"""What the record of a run says of the policy."""

from __future__ import annotations

from typing import Any

from dual_ur10.policies import is_path
from dual_ur10.policies.learned import shipped
from dual_ur10.policies.policy import Policy


def about(policy: Policy | str, env_id: str) -> dict[str, Any]:
    """Name and hash of a policy, as `record_about` of an environment takes them.

    The hash is that of a checkpoint's manifest, which holds the hash of its weights. What is no checkpoint has none: a
    scripted policy is told by its name and the version of this package, which every record has.

    Args:
        policy: A policy, or what it is called: a name, or the folder of a checkpoint.
        env_id: Id of the environment.

    Raises:
        UnknownNameError: There is no learned policy for this environment.
        CheckpointError: The checkpoint cannot be read, or is not as it was saved.
    """
    if not isinstance(policy, str):
        return {"policy": type(policy).__name__}
    folder = str(shipped.folder_of(policy, env_id)) if policy in shipped.NAMES else policy
    if not is_path(folder):
        return {"policy": policy}
    from dual_ur10.policies.learned.checkpoint import sha256_of

    return {"policy": policy, "policy_sha256": sha256_of(folder)}
