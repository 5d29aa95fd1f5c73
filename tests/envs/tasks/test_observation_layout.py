import numpy as np
import pytest

from dual_ur10.envs.tasks.observation_layout import ConciseView, Field, ObservationLayout
from dual_ur10.errors import ActionError, SettingsError, UnknownNameError

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


def test_layouts_with_fewer_fields():
    assert LAYOUT.without("q_rad").names == ("time_s",)
    assert LAYOUT.indices(["time_s", "q_rad"]) == [0, 1, 2]
    with pytest.raises(UnknownNameError, match=r"observation field 'role'.*'q_rad', 'time_s'"):
        LAYOUT.indices(["role"])


def test_batches_have_the_shape_of_observations():
    assert LAYOUT.batch([1, 2, 3, 4, 5, 6], "Task").tolist() == [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]
    for shape in ((5,), (2, 7), (1, 2, 6)):
        with pytest.raises(ActionError, match=r"of Task has shape \(6,\) or \(n, 6\), found"):
            LAYOUT.batch(np.zeros(shape), "Task")


ARM = Field("commanded_q_rad", 6, -6.5, 6.5, "angle (rad)", "commanded joint positions")
STEP = Field("step_m", 2, -9.0, 9.0, "position (m)", "step", concise=(0.1, 0.01))
ROLE = Field("role", 1, -1.0, 1.0, "sign", "role", concise=(0.2,))
HOME_RAD = np.stack([np.arange(6.0), -np.arange(6.0)])


def test_the_concise_view_scales_each_marked_field_by_its_units():
    layout = ObservationLayout(ROLE, ARM, Field("hidden", 3, -1.0, 1.0, "ratio", "hidden"), STEP)
    view = ConciseView(layout, HOME_RAD, "Task")
    assert view.layout.names == ("commanded_q_rad", "role", "step_m")
    assert view.layout.size == 6 + 1 + 4
    values = {
        "role": np.array([[[1.0], [-1.0]]]),
        "commanded_q_rad": HOME_RAD[None] + np.array([[[1.0], [-3.0]]]),
        "hidden": np.full((1, 2, 3), 7.0),
        "step_m": np.array([[[0.1, -0.01], [8.9, 0.0]]]),
    }
    found = view(layout.join(values))
    assert found.dtype == np.float32
    assert found.shape == (1, 22)
    fields = view.layout.split(found)
    assert fields["commanded_q_rad"][0] == pytest.approx(np.array([[0.5] * 6, [-0.75] * 6]))
    assert fields["role"][0, :, 0] == pytest.approx([1.0 / 1.2, -1.0 / 1.2])
    # All values in the first unit, then all in the second.
    near = [[0.5, -0.01 / 0.11, 0.1 / 0.11, -0.5], [8.9 / 9.0, 0.0, 8.9 / 8.91, 0.0]]
    assert fields["step_m"][0] == pytest.approx(np.array(near))
    assert np.abs(found).max() < 1.0


def test_a_layout_that_marks_no_field_has_no_concise_view():
    with pytest.raises(SettingsError, match=r"'goals', and Lift marks no field.*concise=\(0\.1, 0\.01\).*'state'"):
        ConciseView(ObservationLayout(ARM, LAYOUT.fields[0]), HOME_RAD, "Lift")
    with pytest.raises(SettingsError, match=r"'step_m' is \(0\.1, 0\.0\): units are above 0"):
        Field("step_m", 2, -9.0, 9.0, "position (m)", "step", concise=(0.1, 0.0))
