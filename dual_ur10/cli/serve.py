"""The command `serve`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dual_ur10.cli.options import Settings, check_extras, console, keywords_of


def serve(
    policy: Annotated[
        str,
        typer.Argument(
            metavar="CHECKPOINT",
            help="The folder of a checkpoint; or, with --env, scripted, learned, or module:Class, which may be a chunk "
            "policy.",
        ),
    ],
    env: Annotated[
        str | None, typer.Option("--env", metavar="ENV", help="Environment. Default: that of the checkpoint.")
    ] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port; 0: any that is free.")] = 8000,
    bind: Annotated[
        str | None,
        typer.Option(
            "--bind", metavar="ADDRESS", help="Address for other machines. Needs --token. Default: 127.0.0.1."
        ),
    ] = None,
    token: Annotated[
        Path | None,
        typer.Option(
            "--token", metavar="FILE", help="File with the token that clients must send, 16 characters or more."
        ),
    ] = None,
    settings: Settings = None,
) -> None:
    """Serve a policy to programs that speak openpi's WebSocket protocol, until Ctrl-C."""
    check_extras(("remote", "a policy server"))
    from dual_ur10.policies.remote.remote_policy import token_of
    from dual_ur10.policies.serving import server_of

    server = server_of(
        policy,
        env,
        keywords_of(settings, False),
        host=bind or "127.0.0.1",
        port=port,
        token=None if token is None else token_of(token),
    )
    console.print(f"serving {policy} at {server.address} until Ctrl-C", soft_wrap=True, highlight=False, markup=False)
    try:
        server.run()
    finally:
        server.close()
