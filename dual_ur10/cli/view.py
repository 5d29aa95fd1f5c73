"""The command `view`."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from dual_ur10.cli.options import (
    EnvName,
    OperatorName,
    Perturbed,
    PolicyName,
    Seed,
    Settings,
    close,
    console,
    keywords_of,
    make,
)


def view(
    env: EnvName,
    policy: PolicyName = "scripted",
    operator: OperatorName = None,
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="Stop after this time.")] = None,
    seed: Seed = 0,
    settings: Settings = None,
    perturbed: Perturbed = False,
) -> None:
    """Watch a policy or an operator in real time, in a window or, without a display, in a browser on this machine."""
    from dual_ur10.policies.evaluation.rollout import act

    keywords = keywords_of(settings, perturbed)
    made, actor = make(env, policy, {**keywords, "render_mode": "human"}, seed, operator)
    period_s = made.unwrapped.core.timing.period_s
    try:
        observation, _ = made.reset(seed=seed)
        actor.reset()
        viewer = made.unwrapped.viewer
        if viewer.url:
            console.print(f"the viewer is at [bold cyan]{viewer.url}[/] for browsers on this machine", soft_wrap=True)
        console.print("Ctrl-C ends it", style="dim")
        begun = due = time.monotonic()
        while viewer.is_running() and (seconds is None or due - begun < seconds):
            observation, _, terminated, truncated, _ = made.step(act(actor, observation, made, made.action_space.dtype))
            if terminated or truncated:
                observation, _ = made.reset()
                actor.reset()
            # Against the clock, not from step to step: delays do not add up. A delay beyond 0.5 s is dropped.
            due = max(due + period_s, time.monotonic() - 0.5)
            time.sleep(max(0.0, due - time.monotonic()))
    except KeyboardInterrupt:
        console.print("closed")
    finally:
        close(made, actor)
