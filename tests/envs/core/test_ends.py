import pytest

from dual_ur10.envs.core.ends import early_end, refusal
from dual_ur10.sim2real.control.gate import Verdict


@pytest.mark.parametrize(
    ("reason", "text"),
    [
        (None, ""),
        ("success", ""),
        ("time", ""),
        ("physics", "diverged"),
        ("refused/joint_speed", "too fast"),
        ("bar_lost", "bar_lost"),
    ],
)
def test_an_early_end_is_told_by_its_own_detail(reason, text):
    info = {"safety": "too fast", "physics_error": "diverged"}  # of a refusal that did not end the episode, say
    assert early_end(info if reason is None else {**info, "end_reason": reason}) == text


def test_the_reason_of_a_refusal_names_the_limit():
    assert refusal(Verdict("Cartesian speed", "left/tcp", 2.0, 1.5, 7)) == "refused/cartesian_speed"
