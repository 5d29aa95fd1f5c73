"""The command `serve`, as far as it does not serve."""

import pytest

from tests.cli.command import run


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["learned"], "needs an environment: name it with --env"),
        (["learned", "--env", "SineTracking", "--bind", "0.0.0.0"], "give it a token"),
        (["learned", "--env", "SineTracking", "--bind", "lab"], "no IP address"),
        (["learned", "--env", "SineTracking", "--token", "none"], "cannot be read"),
        (["missing/checkpoint"], "missing/checkpoint"),
    ],
)
def test_what_cannot_be_served_is_an_error_in_a_line(arguments, text):
    code, output = run("serve", *arguments)
    assert code == 2
    assert text in output
