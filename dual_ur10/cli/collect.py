"""The command `collect`, and what a person who demonstrates is shown."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from dual_ur10.cli.options import (
    RUNS,
    CellName,
    EnvName,
    OneArm,
    OperatorName,
    PolicyName,
    Randomization,
    Record,
    Settings,
    TakeoverName,
    check_extras,
    console,
    errors,
    progress_of,
    randomize,
    record_in,
)
from dual_ur10.cli.session import asks, close, keywords_on, make
from dual_ur10.ids import env_id_of
from ur_core.processes.interrupts import INTERRUPTED

if TYPE_CHECKING:
    from dual_ur10.policies.operators.operator import Operator
    from dual_ur10.policies.training.demonstrations import Demonstration

_KEYS = "b begins an episode, return keeps it, backspace discards it, n begins it anew; Ctrl-C ends"
_OF_PAGE = "Record begins an episode, Success keeps it, Discard throws it away, Reset begins it anew; Ctrl-C ends"

TAKES_KEYS = "; 1, 2, 3 take the left arm, the right one, both, 0 hands back"
"""Keys of the terminal with which a person takes over, in words."""


class Kept:
    """Prints the end of each demonstrated episode, and shows in the page what is kept.

    Args:
        operator: Operator, whose buttons it names.
        more: Further keys of the terminal.
    """

    def __init__(self, operator: Operator, more: str = "") -> None:
        from dual_ur10.policies.operators.page import PageDevice

        has_page = isinstance(operator.device, PageDevice)
        console.print(_OF_PAGE if has_page else f"{_KEYS}{more}", highlight=False, soft_wrap=True)
        self._count, self._total_s = 0, 0.0
        self._env: Any = None

    def shown_in(self, env: Any) -> Any:
        """Return an environment, whose page shows what is kept if it has one."""
        from dual_ur10.envs.rendering.live.shown import Shown

        self._env = env if isinstance(env, Shown) else None
        self._show()
        return env

    def _show(self) -> None:
        if self._env is not None:
            self._env.words["kept"] = f"{self._count} episodes, {self._total_s:.0f} s"
            self._env.waiting = "press Record to begin an episode"
            self._env.say()

    def __call__(self, found: Demonstration) -> None:
        """Print it."""
        if found.kept:
            self._count, self._total_s = self._count + 1, self._total_s + found.time_s
        end = "kept" if found.kept else "thrown away"
        console.print(
            f"{end} after {found.time_s:.1f} s ({escape(found.ended_by)}); {self._count} kept, {self._total_s:.0f} s"
        )
        self._show()


def collect(
    env: EnvName,
    policy: PolicyName = "scripted",
    operator: OperatorName = None,
    takeover: TakeoverName = None,
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Number of episodes.")] = 100,
    dataset: Annotated[
        str | None,
        typer.Option("--dataset", metavar="ID", help="Minari's dataset id, such as ur10/carry/mine-v0."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Seed of the first episode.")] = 100_000,
    envs: Annotated[int, typer.Option("--envs", min=1, help="Number of cells stepped together.")] = 16,
    randomization: Randomization = None,
    settings: Settings = None,
    cell: CellName = None,
    arm: OneArm = None,
    record: Record = RUNS,
    author: Annotated[str | None, typer.Option("--author", help="Kept in the dataset.")] = None,
    email: Annotated[str | None, typer.Option("--author-email", help="Kept in the dataset.")] = None,
    code: Annotated[str | None, typer.Option("--code-permalink", help="Kept in the dataset.")] = None,
) -> None:
    """Run a policy and write a Minari dataset of its episodes, with one key per agent.

    With --operator or --takeover a person demonstrates, also on a --cell: the keys b, return and backspace begin, keep
    and discard an episode. What is kept is recorded at once; after Ctrl-C, and when the command is repeated after a
    crash, all of it is in the dataset.
    """
    from dual_ur10.policies.training.dataset import collect as run

    check_extras(("data", "a dataset"), cell=cell, devices=[operator, takeover])
    env_id = env_id_of(env)
    keywords = keywords_on(cell, env_id, settings, False, arm)
    randomize(keywords, randomization)
    source = "operator" if operator or takeover else Path(policy).name
    name = dataset or f"dual-ur10/{env_id.split('/')[1].rsplit('-v', 1)[0].lower()}/{source}-v0"
    if operator or takeover:
        about = {"author": author, "author_email": email, "code_permalink": code}
        _demonstrate(env, policy, operator, takeover, keywords, name, record, episodes, seed, about)
        return
    with progress_of(console, asks(cell)) as progress:
        bar = progress.add_task("running", total=episodes)
        well = 0

        def show(done: int, successes: int) -> None:
            nonlocal well
            well = successes
            progress.update(bar, completed=done, description=f"{successes} of {done} successful")

        made = run(
            env_id,
            name,
            policy=policy,
            episodes=episodes,
            seed=seed,
            envs=envs,
            env_kwargs=keywords,
            author=author,
            author_email=email,
            code_permalink=code,
            on_progress=show,
        )
    console.print(
        f"{escape(name)}: {made.total_episodes} episodes, {well} of them successful, {made.total_steps} steps; "
        f"minari.load_dataset({escape(repr(name))})",
        highlight=False,
        soft_wrap=True,
    )


def _demonstrate(
    env: str,
    policy: str,
    operator: str | None,
    takeover: str | None,
    keywords: dict[str, Any],
    name: str,
    record: Path,
    episodes: int,
    seed: int,
    about: dict[str, str | None],
) -> None:
    """Let a person demonstrate, and write the dataset of what was kept, however it ends."""
    from dual_ur10.envs.core.options import AS_ON_CONTROLLERS
    from dual_ur10.policies.training.dataset import check_new
    from dual_ur10.policies.training.demonstrations import demonstrate, folder_of, make_dataset

    check_new(name)
    folder = folder_of(record, name)
    leader = f"operator {operator}" if operator else f"{policy}, takeover {takeover}"
    record_in(keywords, folder, {"policy": leader})
    if "cell" not in keywords:
        keywords = {**AS_ON_CONTROLLERS, **keywords}
    made, actor = make(env, policy, keywords, seed, operator, takeover, keys=True)
    kept = Kept(actor.operator if takeover else actor, TAKES_KEYS if takeover else "")
    interrupted = False
    try:
        demonstrate(kept.shown_in(made), actor, episodes=episodes, seed=seed, on_end=kept)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        close(made, actor)
        found = make_dataset(folder, name, **about)
        if found is None:
            errors.print("nothing was kept", highlight=False)
        else:
            console.print(
                f"{escape(name)}: {found.total_episodes} episodes, {found.total_steps} steps; "
                f"minari.load_dataset({escape(repr(name))}); records in {escape(str(folder))}",
                highlight=False,
                soft_wrap=True,
            )
    if interrupted:
        raise typer.Exit(INTERRUPTED)
