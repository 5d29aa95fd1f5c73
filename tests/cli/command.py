"""The command line in this process."""

import re

from typer.testing import CliRunner

from dual_ur10.cli import main as cli


def run(*arguments: str) -> tuple[int, str]:
    """Exit code and what was printed, without colours."""
    result = CliRunner().invoke(cli.app, list(arguments), env={"COLUMNS": "160"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, re.sub(r"\x1b\[[0-9;]*m", "", result.output)
