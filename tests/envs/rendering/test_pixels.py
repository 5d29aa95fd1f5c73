import functools
import os
import pickle
import subprocess
import sys
import threading
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import dual_ur10  # noqa: F401 - registers the ids
from dual_ur10 import errors
from dual_ur10.assets.visuals import CAMERAS, cameras
from dual_ur10.envs.api.dual_arm_env import DualArmEnv
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.rendering.images import Canvas
from dual_ur10.ids import ENV_IDS
from tests.envs.equality import equal

SINE = "DualUR10/SineTracking-v0"
WITH_GRIPPERS = [name for name in ENV_IDS if EnvSetup.resolve(name, {}).config.equipment.grippers]
SMALL = {"width": 48, "height": 40, "cameras": ("front", "overhead")}


def single(observation="pixels", **keywords):
    return gym.make(SINE, observation=observation, **{**SMALL, **keywords})


def vector(n=2, observation="pixels", threads=1, **keywords):
    """Make n cells on one thread: making an OpenGL context for each takes longer than all images of a test."""
    return gym.make_vec(SINE, num_envs=n, observation=observation, threads=threads, **{**SMALL, **keywords})


def actions(steps, n=None, seed=0):
    shape = (steps, 12) if n is None else (steps, n, 12)
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)


def row(observation, k):
    if isinstance(observation, dict):
        return {name: row(value, k) for name, value in observation.items()}
    return observation[k]


def arrays(observation):
    return (
        [each for value in observation.values() for each in arrays(value)]
        if isinstance(observation, dict)
        else [observation]
    )


def changes(env, steps, every_row=lambda image: image):
    """Return, for each step, True if the image of the first camera is a new one."""
    last, result = every_row(env.reset(seed=0)[0]["front"]), []
    for action in actions(steps, getattr(env, "num_envs", None)):
        image = every_row(env.step(action)[0]["front"])
        result.append(not np.array_equal(image, last))
        last = image
    return result


def counted(monkeypatch):
    """Return a list to which each image drawn from now on adds its camera."""
    drawn = []
    image = Canvas.image

    def counting(self, data, camera, out=None):
        drawn.append(camera)
        return image(self, data, camera, out)

    monkeypatch.setattr(Canvas, "image", counting)
    return drawn


def test_gymnasium_checks_it_without_a_warning():
    env = single("both", pixels_rate_hz=12.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ResourceWarning)  # of MuJoCo's web viewer, as in test_env
        check_env(env.unwrapped, skip_render_check=True)  # which environments without images pass
    env.close()


@pytest.mark.parametrize("kind", ["pixels", "flat"])
def test_stable_baselines_checks_it_without_a_warning(kind):
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs the extra train")
    env = single(kind).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(env, warn=True)
    env.close()


def test_stable_baselines_learns_from_images_and_numbers():
    sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra train")
    env = single("flat", observation_dtype="float32")
    model = sb3.PPO("MultiInputPolicy", env, n_steps=4, batch_size=4, n_epochs=1, seed=0).learn(4)
    assert set(model.policy.features_extractor.extractors) == {"state", "front", "overhead"}
    assert model.predict(env.reset(seed=0)[0])[0].shape == (12,)


@pytest.mark.parametrize(("kind", "dtype"), [("pixels", "float64"), ("both", "float32"), ("flat", "float64")])
def test_spaces_and_observations_fit(kind, dtype):
    env, envs = single(kind, observation_dtype=dtype), vector(3, kind, observation_dtype=dtype)
    state = gym.make(SINE, observation_dtype=dtype).observation_space
    assert state.dtype == dtype
    image = gym.spaces.Box(0, 255, (40, 48, 3), np.uint8)
    pixels = gym.spaces.Dict({"front": image, "overhead": image})
    both = gym.spaces.Dict({"state": state, "pixels": pixels})
    expected = {"pixels": pixels, "both": both, "flat": gym.spaces.Dict({"state": state, **pixels.spaces})}[kind]
    assert env.observation_space == envs.single_observation_space == expected
    assert envs.observation_space == gym.vector.utils.batch_space(expected, 3)
    for each, size in ((env, None), (envs, 3)):
        assert each.reset(seed=0)[0] in each.observation_space
        assert each.step(actions(1, size)[0])[0] in each.observation_space


def test_images_show_what_each_camera_sees_and_that_arms_move():
    env = single(width=120, height=90, cameras=CAMERAS)
    before, _ = env.reset(seed=0)
    assert set(before) == set(CAMERAS)
    for action in actions(15) * 0 + np.float32(0.3):
        after, *_ = env.step(action)
    for camera in CAMERAS:
        assert np.std(before[camera]) > 10
        moved = np.abs(before[camera].astype(int) - after[camera]).max(axis=2) > 20
        assert 0.003 < moved.mean() < 0.5, camera
    images = list(before.values())
    assert all((a != b).mean() > 0.5 for k, a in enumerate(images) for b in images[:k])


def difference(a, b):
    """Return the mean absolute difference of two images."""
    return np.abs(a.astype(int) - b).mean()


def test_an_observed_image_shows_what_render_shows():
    env = single(render_mode="rgb_array", camera="overhead", width=84, height=84)
    env.reset(seed=0)
    last = None
    for action in actions(2):
        observation, *_ = env.step(action)
        rendered = env.render()
        assert difference(rendered, observation["overhead"]) < 2.0  # edges and shades
        assert difference(rendered, observation["front"]) > 20.0
        assert last is None or difference(rendered, last) > 0.0
        last = rendered
    envs = vector(render_mode="rgb_array", camera="overhead", width=84, height=84)
    observation, _ = envs.reset(seed=0)
    for row_rendered, row_observed in zip(envs.render(), observation["overhead"], strict=True):
        assert difference(row_rendered, row_observed) < 2.0


def test_rows_are_drawn_on_all_threads_and_equal_those_of_one():
    def painters():
        return [thread.name for thread in threading.enumerate() if thread.name.startswith("painter")]

    images = []
    for threads in (1, 3):
        env = vector(4, threads=threads, randomization="wide")
        images.append(env.reset(seed=0)[0])
        assert len(painters()) == (0 if threads == 1 else 3)
        env.close()
        assert not painters()
    assert equal(*images)


def test_an_environment_that_nobody_closes_ends_with_the_program(tmp_path):
    code = (
        "import gymnasium, dual_ur10\n"
        f"env = gymnasium.make_vec({SINE!r}, num_envs=3, threads=2, observation='pixels', width=40, height=40)\n"
        "assert env.reset(seed=0)[0]['front'].std() > 10\n"
        "del env\n"
        f"env = gymnasium.make_vec({SINE!r}, num_envs=3, threads=2, observation='pixels', width=40, height=40)\n"
        "assert env.reset(seed=0)[0]['front'].std() > 10\n"
    )
    result = run(code, tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""


def test_drawing_changes_no_bit_of_the_physics():
    keywords = {"render_mode": "rgb_array", "pixels_rate_hz": 12.5, "shadows": True}
    plain, rendered = gym.make(SINE), single("both", **keywords)
    left, right = plain.reset(seed=5), rendered.reset(seed=5)
    assert equal(left[1], right[1])
    for action in actions(6):
        left, right = plain.step(action), rendered.step(action)
        rendered.render()
        assert np.array_equal(left[0], right[0]["state"])
        assert left[1:4] == right[1:4]
        assert equal(left[4], right[4])
        states = [each.unwrapped.core.cell._physics._batch.state for each in (plain, rendered)]
        assert np.array_equal(*states)


def test_same_seed_gives_same_images_after_other_episodes():
    fresh, used = single("both"), single("both")
    for seed in range(3):
        used.reset(seed=seed)
        used.step(actions(1)[0])
    assert equal(fresh.reset(seed=7)[0], used.reset(seed=7)[0])
    for action in actions(5):
        assert equal(fresh.step(action)[0], used.step(action)[0])
    assert not equal(fresh.reset(seed=8)[0], used.reset(seed=9)[0])


def test_a_row_of_a_batch_sees_what_the_single_environment_sees():
    envs, singles = vector(3, "both", pixels_rate_hz=12.5), [single("both", pixels_rate_hz=12.5) for _ in range(3)]
    observation, _ = envs.reset(seed=4)
    for k, env in enumerate(singles):
        assert equal(row(observation, k), env.reset(seed=4 + k)[0])
    for action in actions(5, 3):
        observation = envs.step(action)[0]
        for k, env in enumerate(singles):
            assert equal(row(observation, k), env.step(action[k])[0])


@pytest.mark.parametrize("make", [single, vector])
def test_observations_are_copies(make):
    env = make(observation="both", pixels_rate_hz=5)
    kept = [env.reset(seed=0)[0]]
    copies = [pickle.loads(pickle.dumps(kept[0]))]
    for action in actions(7, getattr(env, "num_envs", None)):
        kept.append(env.step(action)[0])
        copies.append(pickle.loads(pickle.dumps(kept[-1])))
    assert all(equal(a, b) for a, b in zip(kept, copies, strict=True))
    every = [each for observation in kept for each in arrays(observation)]
    assert not any(np.shares_memory(a, b) for k, a in enumerate(every) for b in every[:k])
    for each in arrays(kept[-1]):
        each[...] = 0  # what the caller does with them is not seen by the next ones
    image = arrays(env.step(actions(1, getattr(env, "num_envs", None))[0])[0])[0]
    assert image.max() > 0


def test_images_come_at_their_rate(monkeypatch):
    drawn = counted(monkeypatch)
    assert changes(single(), 6) == [True] * 6
    drawn.clear()
    assert changes(single(pixels_rate_hz=25 / 3), 9) == [False, False, True] * 3
    assert drawn == ["front", "overhead"] * 4
    assert changes(single(policy_rate_hz=62.5, pixels_rate_hz=31.25), 4) == [False, True] * 2


def test_an_episode_begins_with_a_new_image_and_its_own_count():
    env = single(pixels_rate_hz=25 / 3)
    last, _ = env.reset(seed=0)
    for action in actions(4):
        last, *_ = env.step(action)
    first, _ = env.reset(seed=1)
    assert not equal(first, last)
    assert equal(first, single().reset(seed=1)[0])
    changed = [not equal(env.step(action)[0], first) for action in actions(3)]
    assert changed == [False, False, True]


def test_a_partial_reset_draws_only_the_reset_rows(monkeypatch):
    env = vector(3, "both", pixels_rate_hz=25 / 3)
    env.reset(seed=0)
    for action in actions(2, 3):
        before, *_ = env.step(action)
    drawn = counted(monkeypatch)
    after, _ = env.reset(seed=[None, 50, None], options={"reset_mask": np.array([False, True, False])})
    assert len(drawn) == 2
    assert [equal(row(before, k), row(after, k)) for k in range(3)] == [True, False, True]
    assert equal(row(after, 1), single("both").reset(seed=50)[0])
    images = []
    for action in actions(3, 3):
        observation = env.step(action)[0]
        images.append(observation["pixels"]["front"])
    start = after["pixels"]["front"]
    # Rows 0 and 2 were in the third period of theirs, row 1 counts from its reset.
    assert [[not np.array_equal(now[k], start[k]) for k in range(3)] for now in images] == [
        [True, False, True],
        [True, False, True],
        [True, True, True],
    ]


def test_next_step_autoreset_draws_each_row_once(monkeypatch):
    env = vector(2, "both", duration_s=0.2, cameras=("front",))
    env.reset(seed=0)
    for action in actions(5, 2):
        observation, _, _, truncated, _ = env.step(action)
    assert truncated.all()
    assert not equal(row(observation, 0), single("both", cameras=("front",)).reset(seed=0)[0])
    drawn = counted(monkeypatch)
    observation, *_ = env.step(actions(1, 2)[0])
    assert len(drawn) == 2
    control = single("both", duration_s=0.2, cameras=("front",))
    control.reset(seed=0)
    for action in actions(5, 2):
        control.step(action[0])
    assert equal(row(observation, 0), control.reset()[0])


def test_same_step_autoreset_gives_the_last_images_too():
    keywords = {"duration_s": 0.2, "pixels_rate_hz": 12.5}
    env, control = vector(2, "both", autoreset_mode="SameStep", **keywords), single("both", **keywords)
    env.reset(seed=0)
    control.reset(seed=0)
    for action in actions(5, 2):
        observation, _, _, truncated, info = env.step(action)
        last = control.step(action[0])[0]
    assert truncated.all()
    assert equal(info["final_obs"][0], last)
    assert info["final_obs"][1] in env.single_observation_space
    assert equal(row(observation, 0), control.reset()[0])
    copy = pickle.loads(pickle.dumps(info["final_obs"][0]))
    env.step(actions(1, 2)[0])
    assert equal(info["final_obs"][0], copy)


def test_disabled_autoreset_leaves_the_images_of_other_rows():
    env = vector(2, duration_s=0.2, autoreset_mode="Disabled")
    env.reset(seed=0)
    for action in actions(5, 2):
        before, *_ = env.step(action)
    after, _ = env.reset(options={"reset_mask": np.array([True, False])})
    assert [equal(row(before, k), row(after, k)) for k in range(2)] == [False, True]


@pytest.mark.parametrize("make", [single, functools.partial(vector, threads=2)])
def test_canvases_are_made_with_the_first_image_and_closed_with_the_environment(make, monkeypatch):
    made, closed = [], []
    init, close = Canvas.__init__, Canvas.close
    monkeypatch.setattr(Canvas, "__init__", lambda self, *a, **k: (made.append(self), init(self, *a, **k))[1])
    monkeypatch.setattr(Canvas, "close", lambda self: (closed.append(self), close(self))[1])
    env = make(render_mode="rgb_array")
    assert not made
    env.reset(seed=0)
    painters = env.unwrapped.core.threads
    assert len(made) == painters
    env.render()
    env.step(actions(1, getattr(env, "num_envs", None))[0])
    assert len(made) == painters + 1  # one for `render`
    assert not closed
    env.close()
    assert set(closed) == set(made)
    env.close()
    with pytest.raises(errors.ClosedError):
        env.reset(seed=0)


@pytest.mark.skipif(not WITH_GRIPPERS, reason="no task has grippers")
def test_wrist_cameras_where_there_are_grippers():
    task, keywords = WITH_GRIPPERS[0], {"observation": "pixels", "cameras": "left/wrist", "width": 96, "height": 72}
    env = DualArmEnv(task, render_mode="rgb_array", camera="right/wrist", **keywords)
    observation, _ = env.reset(seed=0)
    assert list(observation) == ["left/wrist"]
    assert np.std(observation["left/wrist"]) > 10
    assert not np.array_equal(env.render(), observation["left/wrist"])
    with pytest.raises(errors.UnknownNameError, match="'right/wrist'"):
        DualArmEnv(task, cameras=("back",))


@pytest.mark.parametrize(
    ("keywords", "error", "texts"),
    [
        ({"cameras": ("front", "back")}, errors.UnknownNameError, ["camera 'back'", *CAMERAS]),
        ({"cameras": ("left/wrist",)}, errors.UnknownNameError, ["'left/wrist'", "'overhead'"]),
        ({"camera": "left/wrist"}, errors.UnknownNameError, ["'left/wrist'", "'overhead'"]),
        ({"cameras": ()}, errors.SettingsError, ["at least one"]),
        ({"cameras": ("front", "front")}, errors.SettingsError, ["front", "once"]),
        ({"pixels_rate_hz": 10}, errors.RateError, ["8.33333 Hz (every 3 ", "12.5 Hz (every 2)", "2.5"]),
        ({"pixels_rate_hz": 20, "policy_rate_hz": 62.5}, errors.RateError, ["15.625", "20.8333"]),
        ({"pixels_rate_hz": 50}, errors.RateError, ["25 Hz at most"]),
        ({"pixels_rate_hz": 0}, errors.RateError, ["above 0"]),
        ({"pixels_rate_hz": float("nan")}, errors.RateError, ["nan"]),
        ({"pixels_rate_hz": "often"}, errors.RateError, ["often"]),
        ({"width": 0}, errors.SettingsError, ["width", "1920"]),
        ({"observation": "image"}, errors.UnknownNameError, ["'image'", "'both'"]),
    ],
)
@pytest.mark.parametrize("make", [single, vector])
def test_bad_keywords(make, keywords, error, texts):
    with pytest.raises(error) as caught:
        make(**keywords)
    assert all(text in str(caught.value) for text in texts), str(caught.value)


def test_one_camera_may_be_a_string():
    assert list(single(cameras="side").reset(seed=0)[0]) == ["side"]


def test_cameras_of_a_scene_without_grippers():
    assert cameras(single().unwrapped.core.config.scene) == CAMERAS


def run(code, tmp_path, **variables):
    """Run Python in a process of its own, where OSMesa cannot be imported."""
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['mujoco.osmesa'] = None\n")
    # MuJoCo's EGL sets the last one in the process that draws with it.
    unwanted = ("DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM")
    clean = {name: value for name, value in os.environ.items() if name not in unwanted}
    paths = os.pathsep.join([str(tmp_path), os.getcwd(), *filter(None, sys.path)])
    environment = {**clean, "PYTHONPATH": paths, "MUJOCO_GL": "", **variables}
    return subprocess.run([sys.executable, "-c", code], env=environment, timeout=120, capture_output=True, text=True)


@pytest.mark.parametrize(
    "variables",
    [{"MUJOCO_GL": "disabled"}, {"MUJOCO_EGL_DEVICE_ID": "4711"}],
    ids=["no backend", "no device"],
)
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems always have a backend")
def test_without_opengl_state_works_and_pixels_name_the_package(variables, tmp_path):
    code = (
        "import gymnasium, dual_ur10, sys\n"
        "from dual_ur10.errors import RenderError\n"
        f"env = gymnasium.make({SINE!r}); env.reset(seed=0); env.step(env.action_space.sample()); env.close()\n"
        f"env = gymnasium.make_vec({SINE!r}, num_envs=2); env.reset(seed=0); env.step(env.action_space.sample())\n"
        "env.close()\n"
        "for make, more in ((gymnasium.make, {}), (gymnasium.make_vec, {'num_envs': 2})):\n"
        f"    env = make({SINE!r}, observation='pixels', **more)\n"
        "    for _ in range(2):\n"
        "        try:\n"
        "            env.reset(seed=0)\n"
        "        except RenderError as error:\n"
        "            assert 'apt-get install libegl1' in str(error), error\n"
        "        else:\n"
        "            sys.exit('an image out of nothing')\n"
        "    env.close()\n"
        "print('done')\n"
    )
    result = run(code, tmp_path, **variables)
    assert result.returncode == 0, result.stderr
    assert result.stdout == "done\n"
    assert result.stderr == ""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems always have a backend")
def test_where_egl_fails_the_next_backend_is_tried(tmp_path):
    # A second backend that is EGL by another name, and can only be had where the first has left nothing behind.
    second = (
        "import os, sys, types\n"
        "assert 'PYOPENGL_PLATFORM' not in os.environ\n"
        "assert not [name for name in sys.modules if name.split('.')[0] == 'OpenGL']\n"
        "del os.environ['MUJOCO_EGL_DEVICE_ID']\n"
        "from mujoco.egl import GLContext\n"
    )
    (tmp_path / "second.py").write_text(second)
    code = (
        "import sys, importlib, gymnasium, dual_ur10\n"
        "from dual_ur10.envs.rendering import images as rendering\n"
        "import mujoco\n"
        "del sys.modules['mujoco.osmesa']\n"
        f"mujoco.__path__.append({str(tmp_path)!r})\n"
        "rendering._BACKENDS = ('egl', 'second')\n"
        f"env = gymnasium.make({SINE!r}, observation='pixels', width=40, height=40)\n"
        "assert env.reset(seed=0)[0]['front'].std() > 10\n"
        "env.close()\n"
    )
    result = run(code, tmp_path, MUJOCO_EGL_DEVICE_ID="4711")
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""


VISUAL = {"light": 0.3, "colour": 0.2, "camera_shift_m": 0.05, "camera_turn_rad": 0.05}


@pytest.mark.parametrize("name", VISUAL)
def test_each_visual_range_changes_images_from_episode_to_episode_and_nothing_else(name):
    keywords = {"randomization": {name: VISUAL[name]}}
    env, plain = single("both", **keywords), single("both")
    first, info = env.reset(seed=1)
    assert -1.0 < info["randomization"]["visual_seed"] < 1.0
    assert not equal(first["pixels"], plain.reset(seed=1)[0]["pixels"])
    stepped = [env.step(action)[0] for action in actions(2)]
    assert not equal(env.reset(seed=2)[0]["pixels"], first["pixels"])
    assert equal(env.reset(seed=1)[0], first)
    for action, observation in zip(actions(2), stepped, strict=True):
        assert equal(env.step(action)[0], observation)
        assert np.array_equal(plain.step(action)[0]["state"], observation["state"])


def test_rows_look_as_single_environments_do():
    keywords = {"randomization": VISUAL}
    env = vector(3, **keywords)
    many, _ = env.reset(seed=3)
    for row_ in range(3):
        assert equal(row(many, row_), single(**keywords).reset(seed=3 + row_)[0])
    assert not equal(row(many, 0), row(many, 1))
    for preset in ("mild", "wide"):
        assert not equal(single(randomization=preset).reset(seed=3)[0], single().reset(seed=3)[0])


def test_masks_of_an_info_share_no_memory():
    env = vector(2, "state", autoreset_mode="SameStep", duration_s=0.2)
    infos = [env.reset(seed=0)[1], *(env.step(action)[4] for action in actions(5, 2))]
    assert "_final_obs" in infos[-1]
    for info in [*infos, infos[-1]["final_info"]]:
        masks = [value for name, value in info.items() if name.startswith("_")]
        assert len(masks) > 1
        assert not any(np.shares_memory(a, b) for k, a in enumerate(masks) for b in masks[:k])


def test_shadows_and_reflections_are_drawn_on_request_only():
    import mujoco

    images = []
    for keywords in ({}, {"shadows": True}):
        env = single(**keywords)
        images.append(env.reset(seed=0)[0])
        flags = env.unwrapped._observer._painters[0].canvas._scene.flags
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            assert bool(flags[flag]) is bool(keywords)
    assert not equal(*images)
