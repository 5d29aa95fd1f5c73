"""Client of JSON lines: answers that are not valid, that are too large, and that come too late."""

import json

import pytest

from tests.links.fake_servers import serving
from ur_core.errors import LinkError, OperationRefusedError, SettingsError
from ur_core.links.json_link import JsonLink

HERE = "127.0.0.1"


def answering(*answers):
    def talk(connection):
        for answer in answers:
            connection.recv(1000)
            connection.sendall(answer)

    return serving(talk)


def test_the_connection_goes_on_after_a_refusal():
    with answering(b'{"ok": false, "error": "no"}\n', b'{"ok": true, "value": [1, 2.5]}\n') as port:
        with JsonLink("camera", HERE, port) as link:
            with pytest.raises(OperationRefusedError, match=r"^no$"):
                link.ask("stop", arm="left")
            assert link.ask("info") == [1, 2.5]
        link.close()


@pytest.mark.parametrize(
    "answer",
    [
        b"nonsense\n",
        b"[1]\n",
        b"{}\n",
        b'{"ok": 1}\n',
        b'{"ok": true, "other": 1}\n',
        b'{"ok": false, "error": 3}\n',
        b"[" * 100_000 + b"\n",
        b"\xff\n",
        b"",
    ],
)
def test_answers_that_are_not_valid(answer):
    with answering(answer) as port, JsonLink("camera", HERE, port) as link, pytest.raises(LinkError, match="'info'"):
        link.ask("info")


def test_an_error_is_short_though_all_of_a_long_answer_is_wrong():
    wrong = json.dumps({"ok": True, **{f"x{number}": 0 for number in range(20_000)}}).encode() + b"\n"
    with answering(wrong) as port, JsonLink("camera", HERE, port) as link:
        with pytest.raises(LinkError, match="is no answer: expected are `ok`") as found:
            link.ask("info")
        assert len(str(found.value)) < 1200


def test_an_answer_without_end():
    def talk(connection):
        connection.recv(1000)
        while True:
            connection.sendall(b"x" * 65536)

    with serving(talk) as port, pytest.raises(LinkError, match="more than 4194304 bytes"):
        JsonLink("camera", HERE, port).ask("info")


def test_a_late_answer_is_not_taken_for_the_next():
    with answering(b"", b"") as port:
        link = JsonLink("camera", HERE, port, 0.2)
        with pytest.raises(LinkError, match="no answer to 'info'"):
            link.ask("info")
    with pytest.raises(LinkError, match=r"camera at 127\.0\.0\.1:\d+: no connection"):
        link.ask("info")


def test_a_time_limit_that_is_not_legal():
    with pytest.raises(SettingsError, match="timeout_s"):
        JsonLink("camera", HERE, 1, 0.0)
