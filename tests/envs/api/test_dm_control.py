"""The dm_env view in dm_control's viewer and under its suite's wrappers, and props of its models and entities."""

import warnings
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.envs import dm_env
from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.policies import load
from dual_ur10.tasks import Prop

pytest.importorskip("dm_control", reason="it has no wheels for Python 3.13")

with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
    warnings.simplefilter("ignore")  # GLFW finds no display
    for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM"):  # which dm_control reads when it is imported
        patch.setenv(name, "egl")
    from dm_control import mjcf
    from dm_control.entities.props.duplo import Duplo
    from dm_control.entities.props.primitive import Primitive
    from dm_control.suite.wrappers import action_noise, action_scale, pixels
    from dm_control.viewer import application

SINE = "SineTracking"
STEPS = 2


class NoWindow:
    """Window of dm_control's viewer that shows nothing: it keeps the frames."""

    shape = (80, 60)

    def __init__(self, *_):
        self.mouse, self.keyboard = mock.MagicMock(), mock.MagicMock()
        self.frames, self.advance = [], None

    def event_loop(self, tick_func):
        for _ in range(STEPS + 1):  # the first tick begins an episode
            self.advance()
            self.frames.append(tick_func().copy())

    def close(self):
        """End nothing."""


@pytest.mark.parametrize("env_id", [SINE, "DualUR10/Free-v0", "DualUR10/SyncCarry-v0"])
def test_the_viewer_runs_a_task(env_id, monkeypatch):
    monkeypatch.setattr(application.gui, "RenderWindow", NoWindow)
    monkeypatch.setattr(application, "_MAX_FRONTBUFFER_SIZE", 128)  # of pixels, which take seconds without a GPU
    app = application.Application(width=80, height=60)
    app._window.advance = app._advance_simulation  # paused, so that no clock decides how many steps there are
    env, seen = dm_env(env_id, seed=0), []
    policy = None if env_id.endswith("Free-v0") else load("scripted", env_id)  # it has none

    def act(step):
        seen.append(step)
        if policy is None:
            return np.zeros(env.action_spec().shape)
        if step.first():
            policy.reset()
        return policy(step.observation)

    app.launch(env, act)
    assert [each.first() for each in seen] == [True] + [False] * (STEPS - 1)
    assert env.physics.time() == pytest.approx(STEPS * env.env.core.timing.period_s)
    assert all(frame.shape == (60, 80, 3) and np.ptp(frame) > 50 for frame in app._window.frames)
    env.close()


def test_what_the_viewer_shows_is_not_what_is_simulated():
    shown, alone = dm_env(SINE, seed=3), dm_env(SINE, seed=3)
    for step in range(6):
        shown.physics.data.xfrc_applied[:] = 1e3
        shown.physics.data.qpos[:] = 0.0
        found, expected = (each.step(np.full(12, 0.3 * step)) if step else each.reset() for each in (shown, alone))
        assert np.array_equal(found.observation, expected.observation)
    assert np.abs(shown.physics.data.qpos).max() > 1.0
    for each in (shown, alone):
        each.close()


def test_a_scaled_action_is_the_same_action():
    plain, scaled = dm_env(SINE, seed=1), action_scale.Wrapper(dm_env(SINE, seed=1), minimum=-3.0, maximum=3.0)
    assert scaled.action_spec().maximum.max() == 3.0
    plain.reset(), scaled.reset()
    for value in (0.2, -0.7):
        expected, found = plain.step(np.full(12, value)), scaled.step(np.full(12, 3.0 * value))
        assert np.allclose(found.observation, expected.observation, atol=1e-6)


def test_noise_on_actions_comes_from_the_seed_and_changes_no_start():
    envs = [dm_env(SINE, seed=seed) for seed in (2, 2, 2)]
    noisy = [*(action_noise.Wrapper(env, scale=0.05) for env in envs[:2]), envs[2]]
    starts = [env.reset().observation for env in noisy]
    assert np.array_equal(starts[0], starts[2])
    ends = [env.step(np.zeros(12)).observation for env in noisy]
    assert np.array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0], ends[2])


def test_pixels_are_images_of_the_present_state():
    env = dm_env(SINE, seed=0)
    wrapped = pixels.Wrapper(env, pixels_only=False, render_kwargs={"height": 48, "width": 64, "camera_id": "front"})
    first = wrapped.reset().observation
    assert first["pixels"].shape == wrapped.observation_spec()["pixels"].shape == (48, 64, 3)
    assert first["state"].shape == env.observation_spec().shape
    for _ in range(5):
        last = wrapped.step(np.ones(12)).observation
    assert not np.array_equal(first["pixels"], last["pixels"])
    assert env.physics.render(48, 64, 0).shape == (48, 64, 3)
    for camera in (-1, 99, "none"):
        with pytest.raises(UnknownNameError, match="front"):
            env.physics.render(camera_id=camera)
    env.close()


def model():
    """Return a placed case with a lid."""
    found = mjcf.RootElement(model="case")
    found.compiler.angle = "radian"
    case = found.worldbody.add("body", name="box", pos=(0.0, 0.4, 0.03), mocap=True)
    case.add("geom", type="box", size=(0.1, 0.1, 0.02))
    lid = case.add("body", name="lid", pos=(0.0, 0.0, 0.05))
    lid.add("joint", name="lid", type="hinge", axis=(0, 1, 0), range=(0.0, 1.5))
    lid.add("geom", type="box", size=(0.1, 0.1, 0.005), mass=0.2)
    return found


def test_props_of_models_and_entities_are_handled():
    props = (
        Prop(name="peg", mjcf=Primitive(geom_type="box", size=(0.02, 0.02, 0.03), mass=0.2)),
        Prop(name="duplo", mjcf=Duplo()),
        Prop(name="case", mjcf=model()),
    )
    assert [(each.free, each.placed, each.joints) for each in props] == [
        (True, False, ()),
        (True, False, ()),
        (False, True, ("lid",)),
    ]
    for each in props:
        each.check()
    assert "sensor" not in props[0].mjcf


def test_a_model_that_needs_files_is_refused(tmp_path):
    (tmp_path / "part.stl").write_bytes(b"solid")
    found = mjcf.RootElement()
    found.asset.add("mesh", name="part", file=str(tmp_path / "part.stl"))
    with pytest.raises(SettingsError, match=r"1 files, such as part.*\.stl: use primitive"):
        Prop(name="part", mjcf=found)


def test_an_arena_may_place_its_entity():
    arena = mjcf.RootElement(model="arena")
    frame = arena.attach(Primitive(geom_type="box", size=(0.02, 0.02, 0.03), mass=0.2, name="peg").mjcf_model)
    frame.pos = (0.0, 0.5, 0.03)
    frame.add("freejoint")
    env = gym.make("DualUR10/Free-v0", objects=(Prop(name="peg", mjcf=arena),))
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    model, data = env.unwrapped.core.cell_data(0)
    assert data.body("peg/peg/").xpos == pytest.approx((0.0, 0.5, 0.03), abs=1e-3)
    assert model.body("peg/peg/").mass == pytest.approx(0.2)
    env.close()
