"""The command `check-configuration`, as a user meets it."""

import pytest

from tests.cli.command import run

TOOLS = "-0.1 0.4 0.2 0 1 0 0 -0.1, -0.4, 0.2, 0, 1, 0, 0"


def test_it_prints_a_report_and_reports_by_its_exit_code(tmp_path):
    path = tmp_path / "lab.toml"
    assert run("cell", "new", str(path), "--left", "192.168.1.10", "--right", "192.168.1.11")[0] == 0
    for cell in ((), ("--cell", str(path))):  # at these addresses nothing answers
        code, text = run("check-configuration", "BoxLift", "--tools", TOOLS, *cell)
        assert code == 0
        assert text.startswith("DualUR10/BoxLift-v0: legal\nleft: tool at (-0.100, 0.400, 0.200) m")
    code, text = run("check-configuration", "BoxLift", "--q", " ".join("0" * 12), "--set", "width_m=0.15")
    assert code == 1
    assert "in the way: left/palm and table" in text


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--q", "0 0"), "--q has 2 numbers: write 12"),
        (("--tools", "a b"), "--tools is 'a b': write 14 numbers"),
        (("--set", "widht_m=1"), "did you mean width_m?"),
    ],
)
def test_what_is_no_configuration_is_refused(options, words):
    code, text = run("check-configuration", "BoxLift", *options)
    assert code == 2
    assert words in text
