import numpy as np
import pytest

from dual_ur10.envs.core.setup import load_task
from dual_ur10.envs.tasks.observation_layout import Field, ObservationLayout
from dual_ur10.errors import ActionError, UnknownNameError
from dual_ur10.ids import ENV_IDS

LAYOUT = ObservationLayout(
    Field("q_rad", 2, -3.0, 4.0, "angle (rad)", "joint positions", "{arm}/a ... {other}/b"),
    Field("time_s", 1, 0.0, 9.0, "time (s)", "time"),
)


def test_both_arms_have_the_fields_of_one_in_their_order():
    assert LAYOUT.names == ("q_rad", "time_s")
    assert LAYOUT.low.tolist() == [-3.0, -3.0, 0.0] * 2
    assert LAYOUT.high.tolist() == [4.0, 4.0, 9.0] * 2
    assert LAYOUT.table() == [
        "| 0-1 | joint positions | -3 | 4 | left/a ... right/b | angle (rad) |",
        "| 2 | time | 0 | 9 | - | time (s) |",
    ]


@pytest.mark.parametrize("shape", [(6,), (5, 6), (2, 5, 6)])
def test_fields_are_views_that_join_to_the_observation(shape):
    observation = np.arange(np.prod(shape), dtype=np.float64).reshape(shape)
    fields = LAYOUT.split(observation)
    assert fields["q_rad"].shape == (*shape[:-1], 2, 2)
    assert fields["time_s"][..., 0].tolist() == observation[..., [2, 5]].tolist()
    if len(shape) == 2:
        assert np.array_equal(LAYOUT.join(fields), observation)
    fields["time_s"][..., 1, :] = -1.0
    assert (observation[..., 5] == -1.0).all()


def test_layouts_with_fewer_and_more_fields():
    longer = LAYOUT.without("q_rad").extended(Field("role", 3, -1.0, 1.0, "sign", "role"))
    assert longer.names == ("time_s", "role")
    assert longer.indices(["role"]) == [1, 2, 3]
    assert LAYOUT.indices(["time_s", "q_rad"]) == [0, 1, 2]
    with pytest.raises(UnknownNameError, match=r"observation field 'role'.*'q_rad', 'time_s'"):
        LAYOUT.indices(["role"])


def test_batches_have_the_shape_of_observations():
    assert LAYOUT.batch([1, 2, 3, 4, 5, 6], "Task").tolist() == [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]
    for shape in ((5,), (2, 7), (1, 2, 6)):
        with pytest.raises(ActionError, match=r"of Task has shape \(6,\) or \(n, 6\), found"):
            LAYOUT.batch(np.zeros(shape), "Task")


@pytest.mark.parametrize("name", ENV_IDS)
def test_agents_observe_the_fields_of_their_arm_first(name):
    task = load_task(name)
    settings = task.settings_type()
    own = task.agent_layout_for(settings)
    assert own.fields[: len(task.layout.fields)] == task.layout_for(settings).fields
