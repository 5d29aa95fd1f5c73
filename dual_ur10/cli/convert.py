"""The command `convert`."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from dual_ur10.cli.options import EnvName, Settings, console, keywords_of
from dual_ur10.errors import CheckpointError, UnknownNameError
from dual_ur10.ids import env_id_of


def convert(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="A model saved by Stable-Baselines3, a zip file.")],
    env: EnvName,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FOLDER", help="Folder to create.")],
    trust_pickle: Annotated[
        bool,
        typer.Option("--trust-pickle", help="Run the code in these files: you trust their author."),
    ] = False,
    vec_normalize: Annotated[
        Path | None, typer.Option("--vec-normalize", metavar="FILE", help="The VecNormalize saved with the model.")
    ] = None,
    algo: Annotated[str | None, typer.Option("--algo", "-a", help="ppo or sac. Default: from the file.")] = None,
    agents: Annotated[
        str | None,
        typer.Option(
            "--agents",
            help="joint: for both arms; shared: for each arm. Default: from the file.",
        ),
    ] = None,
    settings: Settings = None,
) -> None:
    """Convert a model of Stable-Baselines3 to a checkpoint. This runs the code that the file holds."""
    from dual_ur10.policies.learned.checkpoint import check_new, save
    from dual_ur10.policies.learned.from_sb3 import Algorithm, from_sb3
    from dual_ur10.policies.learned.signature import view_of

    env_id, keywords = env_id_of(env), keywords_of(settings, False)
    if algo is not None and algo not in get_args(Algorithm):
        raise UnknownNameError("algorithm", algo, list(get_args(Algorithm)))
    view = view_of(env_id, keywords)
    sizes: dict[str, int] = {"joint": view.signature.observation.shape[0], "shared": view.layout.size}
    if agents is not None and agents not in sizes:
        raise UnknownNameError("agents", agents, list(sizes))
    check_new(out)
    trained, kind = _chosen(model, algo, agents, env_id, sizes)
    policy = from_sb3(
        model,
        env_id,
        algorithm=trained,
        agents=kind,
        vec_normalize=vec_normalize,
        trust_pickle=trust_pickle,
        **keywords,
    )
    manifest = save(out, policy.layers, policy.manifest)
    # With a "/" in it, a folder is never mistaken for the name of a policy.
    folder = out if os.sep in str(out) else f"./{out}"
    options = [word for text in settings or () for word in ("--set", text)]
    for line in (
        f"model   {model}: {trained}, {kind}",
        f"policy  {out}",
        f"sha256  {manifest.weights_sha256}",
        f"evaluate it with: dual-ur10 evaluate {shlex.join([env, '--policy', str(folder), *options])}",
    ):
        console.print(line, highlight=False, soft_wrap=True, markup=False)


def _chosen(model: Path, algo: str | None, agents: str | None, env_id: str, sizes: dict[str, int]) -> tuple[Any, Any]:
    """Return the algorithm and the agents of a model: those that are named, or those of its file.

    Raises:
        CheckpointError: The file tells no algorithm, another one, or observations of another size.
    """
    from dual_ur10.policies.learned.from_sb3 import inspect_model

    specified, size = inspect_model(model)
    if algo is None and specified is None:
        raise CheckpointError(
            f"{model} does not specify PPO or SAC, and no other can be converted: name one with --algo"
        )
    if algo is not None and specified not in (None, algo):
        raise CheckpointError(f"{model} is a model of {specified}, but --algo is {algo}: leave --algo out")
    kind = agents or next((name for name, each in sizes.items() if each == size), "joint")
    if size not in (None, sizes[kind]):
        raise CheckpointError(
            f"{model} observes {size} numbers; in {env_id} both arms together (joint) observe {sizes['joint']}, and "
            f"each of them (shared) {sizes['shared']}: name the environment, --agents and --set of its training"
        )
    return algo or specified, kind
