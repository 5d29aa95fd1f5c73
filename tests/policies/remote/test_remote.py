"""Servers of policies, and their clients, over real sockets on loopback addresses."""

import http.client
import re
import socket
from pathlib import Path

import msgspec
import numpy as np
import pytest
import websockets.sync.client

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import ChunkError, DualUR10Error, PolicyError, PolicyServerError, SettingsError
from dual_ur10.policies import load, make, rollout
from dual_ur10.policies.chunks.executor import ChunkExecutor
from dual_ur10.policies.evaluation.evaluate import evaluate
from dual_ur10.policies.remote import policy_server, remote_policy
from dual_ur10.policies.remote.policy_server import PolicyServer
from dual_ur10.policies.remote.remote_policy import RemoteSteps, connect
from dual_ur10.policies.serving import server_of
from tests.policies.chunks.sources import Sway
from tests.policies.remote.servers import as_openpi, chunk_of, stand_in

SINE = "DualUR10/SineTracking-v0"
OPTIONS = {"duration_s": 1.0, "action_latency_ticks": 5}
OURS = {"dt_s": 0.1, "action_space": "joint_position"}
TOKEN = "0123456789abcdef"


def learned(**keywords):
    """Return the episode of the shipped policy."""
    with make("learned", SINE, **OPTIONS, **keywords)[0] as env:
        return rollout(env, load("learned", SINE, **OPTIONS, **keywords), seed=0)


def test_a_served_checkpoint_acts_as_the_checkpoint_itself():
    with server_of("learned", SINE, OPTIONS, port=0) as server:
        env, policy = make(f"remote:{server.address}", SINE, **OPTIONS)
        assert isinstance(policy, RemoteSteps)
        far = rollout(env, policy, seed=0)
        env.close()
        policy.close()
    assert np.array_equal(far.q_rad, learned().q_rad)


def test_a_server_is_not_asked_about_several_cells():
    with server_of("learned", SINE, OPTIONS, port=0) as server:
        env, policy = make(f"remote:{server.address}", SINE, **OPTIONS)
        observation, _ = env.reset(seed=0)
        env.close()
        assert np.array_equal(policy(observation[None]), policy(observation)[None])
        with pytest.raises(PolicyError, match="2 cells at once"):
            policy(np.stack([observation] * 2))
        policy.close()


def test_a_served_chunk_policy_is_executed_as_the_chunk_policy_itself():
    def run(policy):
        env, actor = make(policy, SINE, duration_s=2.0)
        actor.latency_s = 0.08
        found = rollout(env, actor, seed=0)
        env.close()
        actor.close()
        return found

    with server_of("tests.policies.chunks.sources:Sway", SINE, port=0) as server:
        far = run(f"remote:{server.address}")
    assert np.array_equal(far.q_rad, run(Sway(action_mode="joint_delta")).q_rad)  # it takes the environment's mode
    assert np.ptp(far.q_rad, axis=0).min() > 0.05


class Lift:
    """Policy of single Cartesian steps."""

    def reset(self):
        pass

    def __call__(self, observation):
        return np.tile([0.0, 0.0, 0.5, 0.0, 0.0, 0.0], 2)


def test_an_environment_that_is_refused_leaves_the_server_free():
    with server_of("learned", SINE, OPTIONS, port=0) as server:
        name, held = f"remote:{server.address}", []  # errors hold what their frames had
        for refused in (
            lambda: make(name, SINE, widht=3),
            lambda: evaluate(SINE, name, env_kwargs={"num_envs": 3}),
            lambda: make(name, SINE, widht=3),
        ):
            with pytest.raises(DualUR10Error, match=r"widht|num_envs") as found:
                refused()
            held.append(found)


def test_single_actions_of_any_mode_are_served():
    keywords = {"duration_s": 0.4, "action_mode": "tcp_delta"}
    with server_of(f"{__name__}:Lift", SINE, keywords, port=0) as server:
        env, policy = make(f"remote:{server.address}", SINE, **keywords)
        far = rollout(env, policy, seed=0)
        policy.close()
    assert np.array_equal(far.q_rad, rollout(env, Lift(), seed=0).q_rad)
    env.close()


class Scaling(Sway):
    """Chunk policy that writes into its observation."""

    def chunk(self, observation, time_s):
        observation *= 0.5
        return super().chunk(observation, time_s)


def test_a_served_policy_may_write_into_its_observation():
    with server_of(f"{__name__}:Scaling", SINE, port=0) as server:
        env, policy = make(f"remote:{server.address}", SINE, duration_s=0.4)
        rollout(env, policy, seed=0)
        env.close()
        policy.close()


def client(address, **headers):
    return websockets.sync.client.connect(address, additional_headers=headers, compression=None, proxy=None)


def test_the_server_speaks_openpis_protocol():
    setup = EnvSetup.resolve(SINE, OPTIONS)
    observation = np.zeros(setup.make_task().layout.size * 2)
    with server_of("learned", SINE, OPTIONS, port=0) as server:
        with client(server.address) as one:
            metadata = msgspec.msgpack.decode(one.recv())
            assert (metadata["env_id"], metadata["action_horizon"], metadata["dt_s"]) == (SINE, 1, 0.04)
            one.send(msgspec.msgpack.encode({"observation": as_openpi(observation)}))
            answer = msgspec.msgpack.decode(one.recv())
            assert answer["server_timing"]["infer_ms"] > 0.0
            actions = answer["actions"]
            assert (actions[b"dtype"], actions[b"shape"]) == ("<f4", [1, 12])
            with client(server.address) as two:
                assert "one client at a time" in two.recv()
        for spoiled, text in (
            (b"\xc1", "no msgpack"),
            ("text", "found a text"),
            (msgspec.msgpack.encode([1]), "a request is a dict"),
            (msgspec.msgpack.encode({"state": 1}), "'infer' with 'state'"),
            (msgspec.msgpack.encode({"observation": as_openpi(np.zeros(3))}), "numbers of shape"),
            (msgspec.msgpack.encode({"observation": "x"}), "an observation is an array"),
            (msgspec.msgpack.encode({"endpoint": "quit", "observation": 1}), "'quit'"),
        ):
            for _ in range(100):  # until the server has let the client before go
                with client(server.address) as each:
                    first = each.recv()
                    if isinstance(first, str):
                        continue
                    each.send(spoiled)
                    assert text in each.recv()
                    break
        host, port = re.fullmatch(r"ws://(.*):(\d+)", server.address).groups()
        health = http.client.HTTPConnection(host, int(port))
        health.request("GET", "/healthz")
        assert health.getresponse().read() == b"OK\n"
        health.close()
        with pytest.raises(websockets.exceptions.InvalidStatus, match="403"):
            websockets.sync.client.connect(server.address, origin="http://evil.example", proxy=None)


def test_the_kernel_finds_clients_whose_machine_is_gone():
    accepted = []

    class Watched(PolicyServer):
        def _serve(self, connection):
            accepted.append(connection.socket)
            super()._serve(connection)

    with Watched(Lift(), {}, port=0) as server, client(server.address) as one:
        one.recv()
        (found,) = accepted
        assert found.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        for name, value in policy_server._PROBES.items():
            if hasattr(socket, name):
                assert found.getsockopt(socket.IPPROTO_TCP, getattr(socket, name)) == value


def test_a_silent_client_makes_way_for_the_next_one(monkeypatch):
    monkeypatch.setattr(policy_server, "_TURN_S", 0.2)
    with PolicyServer(Lift(), {}, port=0) as server, client(server.address) as one:
        one.recv()
        with client(server.address) as two:
            assert "one client at a time" in two.recv()
        monkeypatch.setattr(policy_server, "SILENT_S", 0.0)
        with client(server.address) as three:
            assert msgspec.msgpack.decode(three.recv()) == {}
            assert "another client came" in one.recv()


def test_other_machines_need_a_token(tmp_path):
    with pytest.raises(SettingsError, match="give it a token"):
        PolicyServer(None, {}, host="0.0.0.0", port=0)
    with pytest.raises(SettingsError, match="no IP address"):
        PolicyServer(None, {}, host="lab", port=0)
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    with server_of("tests.policies.chunks.sources:Sway", SINE, port=0, token=TOKEN) as server:
        with pytest.raises(PolicyServerError, match="401"):
            connect(f"remote:{server.address}", EnvSetup.resolve(SINE, {}))
        policy = connect(f"remote:{server.address}?token={file}", EnvSetup.resolve(SINE, {}))
        policy.close()
    file.write_text("short")
    with pytest.raises(SettingsError, match="16 characters"):
        connect(f"remote:ws://127.0.0.1:1?token={file}", EnvSetup.resolve(SINE, {}))


def test_an_address_of_ipv6_is_served():
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError as error:
        pytest.skip(f"this machine has no such address: {error}")
    with PolicyServer(Lift(), {}, host="::1", port=0) as server, client(server.address) as one:
        assert msgspec.msgpack.decode(one.recv()) == {}


def run_against(answers, metadata=OURS, **options):
    """Run an episode against a stand-in, and return its executor, the episode's error and what the server received."""
    with stand_in(answers, metadata, **options) as (address, received):
        env, policy = make(f"remote:{address}", SINE, duration_s=4.0)
        policy.latency_s = 0.04
        try:
            rollout(env, policy, seed=0)
            found = None
        except DualUR10Error as error:
            found = error
        finally:
            env.close()
            policy.close()
        return policy, found, received


@pytest.mark.parametrize(
    ("then", "error", "text"),
    [
        (b"\xc1\xc1", PolicyServerError, "2 bytes that are no msgpack"),
        ("Traceback: out of memory", PolicyServerError, "failed: Traceback: out of memory"),
        (msgspec.msgpack.encode({"type": "error", "message": "no prompt"}), PolicyServerError, "failed: 'no prompt'"),
        (msgspec.msgpack.encode({"action": 1}), PolicyServerError, "a dict of 'action': an answer has 'actions'"),
        (msgspec.msgpack.encode([1]), PolicyServerError, "answered with list"),
        (chunk_of(np.zeros((9, 11))), ChunkError, r"\(9, 11\)"),
        (chunk_of(np.full((9, 12), np.nan)), ChunkError, "must be finite"),
        (chunk_of(np.zeros(12)), PolicyServerError, r"shape \(12,\)"),
        (chunk_of(np.zeros((2, 9, 12))), PolicyServerError, r"shape \(2, 9, 12\)"),
        (msgspec.msgpack.encode({"actions": "go"}), PolicyServerError, "shape"),
        (msgspec.msgpack.encode({"actions": ["a" * 2 * 10**7] + [""] * 2 * 10**5}), PolicyServerError, "shape"),
        (msgspec.msgpack.encode({"actions": [[0.0] * 12, [0.0] * 11]}), PolicyServerError, "that are no array"),
        (msgspec.msgpack.encode({"type": as_openpi(np.zeros(2))}), PolicyServerError, "a dict of 'type'"),
        (..., PolicyServerError, "is gone"),
    ],
)
def test_wrong_answers_are_errors_once_both_arms_rest(then, error, text):
    def first(request):
        commanded = np.frombuffer(request["observation"][b"data"]).reshape(2, -1)[:, 12:18].reshape(1, 12)
        return chunk_of(commanded + 0.1 * np.linspace(0.0, 1.0, 15)[:, None] ** 2)

    policy, found, _ = run_against([first, then])
    assert isinstance(found, error)
    assert re.search(text, str(found))
    assert policy.splices == 1


def test_messages_that_are_too_large_are_not_read(monkeypatch):
    monkeypatch.setattr(remote_policy, "MOST_BYTES", 1000)
    policy, found, _ = run_against([chunk_of(np.zeros((100, 12)))])
    assert isinstance(found, PolicyServerError)
    assert "is gone" in str(found)
    assert "1009" in str(found)
    assert policy.splices == 0
    monkeypatch.setattr(policy_server, "MOST_BYTES", 1000)
    with server_of("learned", SINE, OPTIONS, port=0) as server, client(server.address) as one:
        one.recv()
        one.send(bytes(2000))
        with pytest.raises(websockets.exceptions.ConnectionClosedError, match="1009"):
            one.recv()


def test_a_server_that_does_not_answer_is_given_up(tmp_path):
    mapping = tmp_path / "mapping.toml"
    mapping.write_text("timeout_s = 0.05\n")
    with stand_in([None], OURS) as (address, _):
        policy = connect(f"remote:{address}?mapping={mapping}", EnvSetup.resolve(SINE, {}))
        with pytest.raises(PolicyServerError, match=r"has not answered for 0.05 s"):
            policy.source.chunk(np.zeros(94), 0.0)
        with pytest.raises(PolicyServerError, match="is gone"):
            policy.source.chunk(np.zeros(94), 0.0)


def test_a_second_answer_is_not_taken_for_that_of_the_next_observation():
    with stand_in([[chunk_of(np.zeros((4, 12)))] * 2, chunk_of(np.ones((4, 12)))], OURS) as (address, _):
        source = connect(f"remote:{address}", EnvSetup.resolve(SINE, {})).source
        source.chunk(np.zeros(94), 0.0)
        assert source._socket.ping().wait(10.0)  # all that was sent before has come
        with pytest.raises(PolicyServerError, match=r"sent what nobody asked for: \d+ bytes"):
            source.chunk(np.zeros(94), 0.1)
        with pytest.raises(PolicyServerError, match="is gone"):
            source.chunk(np.zeros(94), 0.2)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"greeting": "busy"}, "failed: busy"),
        ({"greeting": b"\x01"}, "began with int"),
        ({"metadata": {"dt_s": 0.1}}, "write dt_s and action_mode"),
        ({"metadata": {**OURS, "env_id": "DualUR10/Handover-v0"}}, "is for 'DualUR10/Handover-v0'"),
        ({"metadata": {**OURS, "keywords": {"observation": "goals"}}}, "--set observation=goals"),
        ({"metadata": {**OURS, "action_horizon": 1}}, "policy_rate_hz=10"),
    ],
)
def test_servers_of_other_policies_are_refused(options, text):
    with stand_in([], **options) as (address, _), pytest.raises(DualUR10Error, match=text):
        make(f"remote:{address}", SINE)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"dt_s": 0.2}, "dt_s 0.1 to 0.2"),
        ({"action_space": "joint_delta"}, "action_space 'joint_position' to 'joint_delta'"),
        ({"action_horizon": 1}, "action_horizon None to 1"),
        ({"env_id": "DualUR10/Handover-v0"}, "env_id None to 'DualUR10/Handover-v0'"),
        ({"keywords": {"action_scale": 0.5}}, "keywords"),
    ],
)
def test_a_server_that_comes_back_with_another_policy_is_refused(change, text):
    metadata = dict(OURS)
    with stand_in([...], metadata) as (address, _):
        source = connect(f"remote:{address}", EnvSetup.resolve(SINE, {})).source
        source.close()
        source.reset()  # the same one is taken
        metadata.update(change)
        source.close()
        for _ in range(2):
            with pytest.raises(PolicyServerError, match=f"another policy than before, from {text}"):
                source.reset()
        assert source.metadata.dt_s == 0.1


ARRAY = np.zeros(2)


@pytest.mark.parametrize(
    ("entries", "text"),
    [
        ({"dt_s": 0}, r"dt_s: .* greater than or equal to 0\.001"),
        ({"dt_s": np.inf}, "dt_s: .* finite"),
        ({"dt_s": True}, "dt_s: .* number"),
        ({"env_id": ARRAY}, "env_id: .* string"),
        ({"action_space": ARRAY}, "action_space: .* string"),
        ({"action_horizon": ARRAY}, "action_horizon: .* integer"),
        ({"endpoints": 5}, "endpoints: .* list"),
        ({"endpoints": ARRAY}, "endpoints: .* list"),
        ({"endpoints": [ARRAY]}, r"endpoints\[0\]: .* string"),
        ({"time_key": ARRAY}, "time_key: .* string"),
        ({"time_key": "t" * 201}, "time_key: .* 200 characters"),
        ({"keywords": 5}, "keywords: .* dictionary"),
        ({"keywords": {"action_scale": ARRAY}}, "keywords.action_scale.* number"),
    ],
)
def test_metadata_of_wrong_types_or_bounds_are_named(entries, text):
    metadata = {**OURS, "action_horizon": 1, 5: ARRAY, "more": ARRAY, **entries}
    with stand_in([], metadata) as (address, _), pytest.raises(PolicyServerError, match=f"not legal: {text}"):
        make(f"remote:{address}", SINE)


@pytest.mark.parametrize(
    "name", ["remote:", "remote:ws://host", "remote:http://h:1", "remote:ws://h:99999", "remote:ws://h:1?key=2"]
)
def test_addresses_are_checked(name):
    with pytest.raises(SettingsError, match=r"write remote:ws://HOST:PORT|no address"):
        load(name, SINE)


def test_no_server_is_a_named_error(monkeypatch):
    monkeypatch.setattr(remote_policy, "_CONNECT_S", 0.2)
    with pytest.raises(PolicyServerError, match=r"no policy server at ws://127\.0\.0\.1:9: .*Is it running"):
        load("remote:ws://127.0.0.1:9", SINE)
    with pytest.raises(PolicyServerError, match=r"no policy server at ws://lab\.\.local:8000: .*label empty"):
        load("remote:ws://lab..local:8000", SINE)
    with pytest.raises(SettingsError, match="needs an environment"):
        load("remote:ws://127.0.0.1:9")


PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "policy-servers.md"
FILES = dict(re.findall(r"```toml\n# (\w+)\.toml\n(.*?)```", PAGE.read_text(), re.DOTALL))


@pytest.mark.parametrize("style", ["aloha", "droid"])
def test_keys_and_layouts_are_those_of_the_mapping(style, tmp_path):
    mapping = tmp_path / "mapping.toml"
    mapping.write_text(FILES[style])
    cameras = ("front", "left/wrist", "right/wrist")
    rows = np.zeros((20, 14)) if style == "aloha" else np.zeros((20, 8))
    rows[:, -1] = 0.25
    with stand_in([chunk_of(rows)]) as (address, received):
        env, policy = make(
            f"remote:{address}?mapping={mapping}", "Handover", observation="both", cameras=cameras, width=24, height=16
        )
        assert isinstance(policy, ChunkExecutor)
        observation, _ = env.reset(seed=0)
        state = observation["state"].reshape(2, -1)
        chunk = policy.source.chunk(observation, 0.0)
        needed = ("front", "left/wrist", "right/wrist") if style == "aloha" else ("front", "right/wrist")
        with pytest.raises(PolicyServerError, match=re.escape(f"use observation='both' and cameras={needed}")):
            policy.source.chunk({**observation, "pixels": {"front": observation["pixels"]["front"]}}, 0.0)
        env.close()
        policy.close()
    (request,) = received
    assert request["prompt"] in FILES[style]
    assert chunk.shape == (20, 14)
    if style == "aloha":
        image, numbers = request["images"]["cam_high"], _array(request["state"])
        assert (image[b"dtype"], image[b"shape"]) == ("|u1", [3, 16, 24])
        assert image[b"data"] == observation["pixels"]["front"].transpose(2, 0, 1).tobytes()
        assert numbers.reshape(2, 7)[:, :6] == pytest.approx(state[:, :6], abs=1e-6)
        assert numbers[[6, 13]] == pytest.approx(1.0, abs=0.05)  # open
        assert chunk[0, [6, 13]] == pytest.approx([-1.0, -0.5])
    else:
        assert request["observation/exterior_image_1_left"][b"shape"] == [16, 24, 3]
        assert _array(request["observation/joint_position"]) == pytest.approx(state[1, :6], abs=1e-6)
        assert _array(request["observation/gripper_position"]) == pytest.approx(0.0, abs=0.05)
        assert chunk[0, :6] == pytest.approx(state[0, 12:18])  # the other arm stays
        assert chunk[0, [6, 13]] == pytest.approx([1.0, 0.5], abs=0.1)


def test_a_server_of_single_actions_gets_the_images_of_one_cell(tmp_path):
    mapping = tmp_path / "mapping.toml"
    mapping.write_text("[state]\nq = ['left.q_rad']\n[images]\nseen = { camera = 'front', layout = 'CHW' }\n")
    metadata = {"dt_s": 0.04, "action_space": "joint_delta", "action_horizon": 1}
    with stand_in([chunk_of(np.zeros((1, 12)))] * 9, metadata) as (address, received):
        keywords = {"observation": "both", "width": 24, "height": 16, "duration_s": 0.2}
        found = evaluate(SINE, f"remote:{address}?mapping={mapping}", episodes=1, env_kwargs=keywords)
    assert found.episodes[0].steps == len(received) == 5
    assert received[0]["seen"][b"shape"] == [3, 16, 24]
    assert _array(received[0]["q"]).shape == (6,)


def _array(sent):
    assert sent[b"dtype"] == "<f4"
    return np.frombuffer(sent[b"data"], "<f4")


def test_a_server_with_endpoints_is_reset(tmp_path):
    mapping = tmp_path / "mapping.toml"
    mapping.write_text("endpoint = true\n")
    answers = [msgspec.msgpack.encode({"status": "reset"}), chunk_of(np.zeros((4, 12)))]
    with stand_in(answers, OURS) as (address, received):
        policy = connect(f"remote:{address}?mapping={mapping}", EnvSetup.resolve(SINE, {}))
        policy.reset()
        policy.source.chunk(np.zeros(94), 0.0)
        policy.close()
    assert [each["endpoint"] for each in received] == ["reset", "infer"]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("actions = ['left.tool']", "left.tool"),
        ("actions = ['left.joints', 'left.joints']", "each once"),
        ("actions = ['skip:0']", "skip: and a number"),
        ("gripper = [1.0, 1.0]", "must differ"),
        ("dt_s = '0.1'", "dt_s"),
        ("speed = 1", "speed"),
        ("a = ", "no TOML"),
        ("[state]\nx = ['left.speed']", "'left.speed' in the state"),
        ("actions = ['left.gripper']", "this environment's have none"),
        ("[images]\nx = { camera = 'front', layout = 'WHC' }", "layout"),
        ("[state]\nx = []", "state.x: .* at least 1"),
        ("[state]\nx = ['left.q_rad']\n'x.y' = ['right.q_rad']", "'x' is a key twice, or also a dict"),
        ("[state]\nx = ['left.q_rad']\n[constants]\nx = 'prompt'", "'x' is a key twice"),
        ("[constants]\n'observation.prompt' = 'go'", "'observation' is a key twice"),
    ],
)
def test_mappings_that_are_not_legal_are_refused(text, found, tmp_path):
    mapping = tmp_path / "mapping.toml"
    mapping.write_text(text)
    with pytest.raises(SettingsError, match=found):
        load(f"remote:ws://127.0.0.1:9?mapping={mapping}", SINE)
    with pytest.raises(SettingsError, match="cannot be read"):
        load(f"remote:ws://127.0.0.1:9?mapping={tmp_path / 'none'}", SINE)
