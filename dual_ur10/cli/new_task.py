"""The command `new-task`."""

from __future__ import annotations

import keyword
import re
import shutil
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from string import Template
from typing import Annotated, Final

import typer
from rich.markup import escape

from dual_ur10 import tasks as facade
from dual_ur10.cli.options import console
from dual_ur10.errors import SettingsError
from dual_ur10.ids import is_registered

_FILES: Final = {
    "pyproject.toml": "pyproject.toml.txt",
    "README.md": "README.md.txt",
    "{package}/__init__.py": "init.py.txt",
    "{package}/py.typed": "",
    "tests/test_task.py": "test_task.py.txt",
}
"""Files of a new project, and their templates."""


def new_task(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the task, such as OpenDrawer.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder to create. Default: from the name.")] = None,
    namespace: Annotated[str, typer.Option("--namespace", help="Namespace of its id.")] = "MyLab",
) -> None:
    """Write a small installable project with a task of your own, its scripted policy and its tests."""
    if re.fullmatch(r"[A-Z][A-Za-z0-9]{0,39}", name) is None:
        raise SettingsError(f"the name of a task is {name!r}: use letters and digits, a capital letter first")
    if re.fullmatch(r"[A-Za-z]\w{0,39}", namespace) is None or namespace == "DualUR10":
        raise SettingsError(f"the namespace is {namespace!r}: use letters, digits and _, and another one than DualUR10")
    env_id = f"{namespace}/{name}-v0"
    if is_registered(env_id):
        raise SettingsError(f"there is a task {env_id} already: choose another name or namespace")
    package = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    if name in facade.__all__ or keyword.iskeyword(name) or keyword.iskeyword(package) or find_spec(package):
        raise SettingsError(f"the name {name} is that of something else in Python or in a task: choose another")
    folder = out or Path(package)
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise SettingsError(f"{folder} exists: name a folder that does not, with --out") from None
    except OSError as error:
        raise SettingsError(f"cannot make {folder}: {error.strerror}. Name another folder with --out") from None
    values = {"name": name, "package": package, "env_id": env_id}
    try:
        for file, template in _FILES.items():
            path = folder / file.format(package=package)
            path.parent.mkdir(exist_ok=True)
            text = (files("dual_ur10.cli") / "task_template" / template).read_text() if template else ""
            path.write_text(Template(text).substitute(values))
    except OSError as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise SettingsError(f"cannot write to {folder}: {error.strerror}. Name another folder with --out") from None
    console.print(f"wrote [bold cyan]{escape(str(folder))}[/]", highlight=False, soft_wrap=True)
    console.print(
        f"pip install -e {escape(str(folder))}; python -m dual_ur10 evaluate {env_id}; pytest {escape(str(folder))}; "
        f"python -m dual_ur10 audit {env_id}",
        style="dim",
        highlight=False,
        soft_wrap=True,
    )
