"""Chunk policy that asks a server, and the policy for servers of single actions."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, get_args
from urllib.parse import parse_qs, urlsplit, urlunsplit

import numpy as np
import pydantic
import websockets.sync.client

from dual_ur10.envs.rendering.pixels import row_of
from dual_ur10.errors import PolicyError, PolicyServerError, SettingsError
from dual_ur10.policies.chunks.chunk_policy import CHUNK_MODES, checked_chunk
from dual_ur10.policies.chunks.executor import executor_for
from dual_ur10.policies.remote.key_mapping import Mapped, WireMapping
from dual_ur10.policies.remote.wire import MOST_BYTES, packed, unpacked
from dual_ur10.sim2real.control.adapter import ActionMode
from ur_core.findings import listed, path_of
from ur_core.tools.tool import strokes_m
from ur_core.types import Array

if TYPE_CHECKING:
    from dual_ur10.envs.core.setup import EnvSetup
    from dual_ur10.policies.policy import Policy

PREFIX: Final = "remote:"
_CONNECT_S: Final = 5.0
_OPTIONS: Final = ("mapping", "token")
_OF_POLICY: Final = ("env_id", "keywords", "dt_s", "action_space", "action_horizon")  # metadata that stay
_RECEIVED: Final = pydantic.ConfigDict(strict=True, extra="ignore", frozen=True, allow_inf_nan=False)

_Text = Annotated[str, pydantic.Field(max_length=200)]


class _Keywords(pydantic.BaseModel):
    """Keywords of the environment that a policy is for, as far as they are compared."""

    model_config = _RECEIVED
    action_mode: _Text | None = None
    action_scale: float | dict[_Text, float] | None = None
    observation: _Text | None = None


class ServerMetadata(pydantic.BaseModel):
    """Metadata of a server, as far as they are used.

    Attributes:
        env_id: Environment that the policy is for.
        keywords: Keywords of that environment.
        endpoints: Endpoints of the server, such as "reset".
        time_key: "time_s": requests state the time of their observation.
        dt_s: Time between two actions of a chunk.
        action_space: Meaning of the actions.
        action_horizon: Number of actions in a chunk.
    """

    model_config = _RECEIVED
    env_id: _Text | None = None
    keywords: _Keywords = _Keywords()
    endpoints: list[_Text] = []
    time_key: _Text | None = None
    dt_s: float | None = pydantic.Field(default=None, ge=1e-3, le=10.0)
    action_space: _Text | None = None
    action_horizon: int | None = None


class RemotePolicy:
    """Chunk policy that asks a server by openpi's WebSocket protocol.

    It sends one observation at a time and waits for the answer, so that a chunk belongs to its observation. The time
    stays on this side. Nothing that is received runs code.

    Args:
        address: Such as "ws://127.0.0.1:8000".
        mapped: Observations and actions in the form of the server.
        token: Text that the server wants, sent as "Authorization: Api-Key ..."; None: none.

    Attributes:
        metadata: Metadata that the server has stated.
        dt_s: Time between two actions of a chunk.
        action_mode: Meaning of the actions, see `ChunkPolicy`.

    Raises:
        PolicyServerError: There is no such server, its metadata are not legal, or neither they nor the mapping state
            `dt_s` and the mode.
    """

    portable: ClassVar[bool] = True

    def __init__(self, address: str, mapped: Mapped, token: str | None = None) -> None:
        self.address, self._mapped, self._token = address, mapped, token
        self.__name__ = f"{PREFIX}{address}"
        self._socket: Any = None
        self.metadata = self._connected()
        mapping = mapped.mapping
        dt_s = mapping.dt_s if mapping.dt_s is not None else self.metadata.dt_s
        mode = mapping.action_mode or self.metadata.action_space
        modes = get_args(ActionMode) if self.metadata.action_horizon == 1 else CHUNK_MODES
        if dt_s is None or mode not in modes:
            self.close()
            raise PolicyServerError(
                f"{address} states dt_s {dt_s!r:.40} and action_space {mode!r:.40}: write dt_s and action_mode, "
                f"{' or '.join(map(repr, CHUNK_MODES))}, into a mapping file, and add ?mapping=FILE to the address"
            )
        self.dt_s, self.action_mode = dt_s, str(mode)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.address!r})"

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_socket": None}  # another process connects anew

    def _connected(self) -> ServerMetadata:
        """Connect, and return the metadata of the server."""
        headers = {} if self._token is None else {"Authorization": f"Api-Key {self._token}"}
        try:
            self._socket = websockets.sync.client.connect(
                self.address,
                additional_headers=headers,
                max_size=MOST_BYTES,
                compression=None,
                ping_interval=None,  # a server that computes does not answer
                open_timeout=_CONNECT_S,
                close_timeout=1.0,
                proxy=None,
            )
        except (OSError, UnicodeError, websockets.exceptions.WebSocketException) as error:  # of the name lab..local
            raise PolicyServerError(f"no policy server at {self.address}: {error}. Is it running?") from error
        found = self._received(_CONNECT_S)
        if not isinstance(found, dict):
            self.close()
            raise PolicyServerError(f"{self.address} began with {type(found).__name__} instead of its metadata")
        try:
            return ServerMetadata.model_validate(found)
        except pydantic.ValidationError as error:
            self.close()
            shown = listed(error.errors(), lambda each: f"{path_of(each['loc'])[1:]}: {each['msg']}", 5)
            raise PolicyServerError(f"{self.address} states metadata that are not legal: {shown}") from None

    def _reconnect(self) -> None:
        """Connect again, and refuse a server that has another policy than at first."""
        before, now = self.metadata, self._connected()
        names = [name for name in _OF_POLICY if getattr(now, name) != getattr(before, name)]
        if names:
            self.close()
            changed = ", ".join(f"{name} {getattr(before, name)!r:.80} to {getattr(now, name)!r:.80}" for name in names)
            raise PolicyServerError(
                f"{self.address} has another policy than before, from {changed}: load the policy again, or start the "
                "server as it was"
            )
        self.metadata = now

    def close(self) -> None:
        """Close the connection. May be called twice."""
        if self._socket is not None:
            self._socket.close()

    def reset(self) -> None:
        """Reset the policy of a server that can be reset; connect again to one that is gone.

        Raises:
            PolicyServerError: It does not answer, or has another policy than before.
        """
        if self._socket is None or self._socket.state is not websockets.protocol.State.OPEN:
            self._reconnect()
        if self._mapped.mapping.endpoint or "reset" in self.metadata.endpoints:
            self._sent({"endpoint": "reset"})
            self._received(self._mapped.mapping.timeout_s, text=True)

    def chunk(self, observation: Any, time_s: float) -> Array:
        """Return the server's chunk for an observation, (H, D).

        Raises:
            PolicyServerError: It is gone, does not answer, or answers with something else.
        """
        request = self._mapped.request(observation)
        if self._socket is None:
            self._reconnect()
        if self.metadata.time_key == "time_s":
            request["time_s"] = time_s
        self._sent(request)
        answer = self._received(self._mapped.mapping.timeout_s)
        key = self._mapped.mapping.action_key
        kind = answer.get("type") if isinstance(answer, dict) else None
        if isinstance(kind, str) and kind == "error":
            raise PolicyServerError(f"{self.address} failed: {answer.get('message')!r:.500}")
        if not isinstance(answer, dict) or key not in answer:
            found = f"a dict of {', '.join(map(repr, answer))}" if isinstance(answer, dict) else type(answer).__name__
            raise PolicyServerError(f"{self.address} answered with {found:.200}: an answer has {key!r}")
        try:
            actions = np.asarray(answer[key]) if _is_of_numbers(answer[key]) else np.zeros(0)
        except ValueError as error:
            raise PolicyServerError(f"{self.address} sent actions that are no array: {error}") from None
        if actions.ndim == 3 and len(actions) == 1:
            actions = actions[0]
        if actions.ndim != 2 or actions.dtype.kind not in "fiu":
            found = f"{actions.dtype} of shape {actions.shape}"
            raise PolicyServerError(f"{self.address} sent actions that are {found}: they must be numbers, (H, D)")
        return self._mapped.chunk(actions.astype(np.float64), observation, self.action_mode)

    def _sent(self, request: dict[str, Any]) -> None:
        """Send a request, unless something has come that would be taken for its answer."""
        try:
            with contextlib.suppress(TimeoutError):
                unasked = self._socket.recv(timeout=0)
                self.close()
                found = unasked.strip()[-500:] if isinstance(unasked, str) else f"{len(unasked)} bytes"
                raise PolicyServerError(f"{self.address} sent what nobody asked for: {found}")
            self._socket.send(packed(request))
        except (OSError, websockets.exceptions.ConnectionClosed) as error:
            raise PolicyServerError(f"{self.address} is gone: {error}") from error

    def _received(self, timeout_s: float, *, text: bool = False) -> Any:
        """Return the content of the next message; a text is an error of the server, unless it is expected."""
        try:
            message = self._socket.recv(timeout=timeout_s)
        except TimeoutError as error:
            self.close()  # a late answer must not be taken for that of another observation
            raise PolicyServerError(
                f"{self.address} has not answered for {timeout_s:g} s: is it overloaded?"
            ) from error
        except (OSError, websockets.exceptions.ConnectionClosed) as error:
            raise PolicyServerError(f"{self.address} is gone: {error}") from error
        if isinstance(message, str):
            if text:
                return message
            self.close()
            raise PolicyServerError(f"{self.address} failed: {message.strip()[-500:]}")
        try:
            return unpacked(message, self.address)
        except PolicyServerError:
            self.close()
            raise


def _is_of_numbers(value: Any) -> bool:
    """Return True if a value holds numbers alone: an array of texts takes the longest one's memory for each of them."""
    if isinstance(value, list):
        return all(map(_is_of_numbers, value))
    return isinstance(value, np.ndarray | int | float)


class RemoteSteps:
    """Policy that asks a server of single actions within the control loop.

    On controllers the answer must come within the latency of actions, or both arms stop.

    Args:
        source: The server.
        size: Numbers of an arm's action.

    Attributes:
        alone: One cell at a time: a server may keep the state of one episode.
    """

    alone: ClassVar[bool] = True

    def __init__(self, source: RemotePolicy, size: int) -> None:
        self.source, self._size = source, size
        self.__name__ = source.__name__

    def reset(self) -> None:
        """Reset the policy of the server."""
        self.source.reset()

    def close(self) -> None:
        """Close the connection. May be called twice."""
        self.source.close()

    def __call__(self, observation: Any) -> Array:
        """Return the float32 action for an observation, or for a batch of one.

        Raises:
            PolicyError: There are several observations: the server would take them for those of one episode.
            PolicyServerError: The server is gone, does not answer, or answers with something else.
            ChunkError: It returned no action.
        """
        part = observation
        while isinstance(part, Mapping):
            part = next(iter(part.values()))
        if np.ndim(part) % 2:  # numbers of a cell have one axis, its images three
            return self._action(observation)
        if len(part) != 1:
            raise PolicyError(
                f"{self.__name__} was asked about {len(part)} cells at once, and its server may keep the state "
                "of one episode: connect once for each cell"
            )
        return self._action(row_of(observation, 0))[None]

    def _action(self, observation: Any) -> Array:
        found = self.source.chunk(observation, 0.0)
        chunk = checked_chunk(found, self.source.dt_s, self._size, self.__name__)
        action: Array = chunk[0].reshape(-1).astype(np.float32)
        return action


def connect(name: str, setup: EnvSetup, **options: Any) -> Policy:
    """Return the policy of a server for an environment.

    Args:
        name: "remote:ws://HOST:PORT", with "?mapping=FILE" and "&token=FILE" if the server wants them.
        setup: The environment.
        **options: `latency_s` and `replan_s` of `ChunkExecutor`.

    Raises:
        SettingsError: The address or a file is not legal, or the environment has other keywords than the policy.
        PolicyServerError: There is no such server, or it has another policy.
    """
    address, mapping, token = _parsed(name)
    task = setup.make_task()
    grippers = setup.config.equipment.grippers and not setup.config.equipment.welded
    mapped = Mapped(mapping, task.layout, strokes_m(setup.config.equipment.tools), grippers=grippers)
    source = RemotePolicy(address, mapped, token)
    try:
        _check_signature(source.metadata, setup, address)
        if source.metadata.action_horizon == 1:
            if abs(source.dt_s - setup.timing.period_s) > 1e-6 or source.action_mode != setup.options.action_mode:
                raise SettingsError(
                    f"{address} returns one action at a time, as {source.action_mode!r} every {source.dt_s:g} s: make "
                    f"the environment with action_mode={source.action_mode!r}, policy_rate_hz={1 / source.dt_s:g}"
                )
            return RemoteSteps(source, 7 if grippers else 6)
        return executor_for(source, setup, silent_s=mapping.timeout_s, **options)
    except BaseException:
        with contextlib.suppress(Exception):
            source.close()
        raise


def _check_signature(metadata: ServerMetadata, setup: EnvSetup, address: str) -> None:
    """Compare what a server of this package states of its policy with an environment."""
    if metadata.env_id not in (None, setup.env_id):
        raise PolicyServerError(f"the policy of {address} is for {metadata.env_id!r:.80}, not for {setup.env_id}")
    for name, value in metadata.keywords.model_dump(exclude_none=True).items():
        found = getattr(setup.options, name)
        if found != value:
            raise SettingsError(
                f"the policy of {address} was made with {name}={value!r:.80}, and the environment has {found!r}: pass "
                f"--set {name}={value}"
            )


def _parsed(name: str) -> tuple[str, WireMapping, str | None]:
    """Return address, mapping and token of a name."""
    try:
        parts = urlsplit(name.removeprefix(PREFIX))
        port, host = parts.port, parts.hostname
    except ValueError as error:
        raise SettingsError(f"{name!r:.200} is no address: {error}") from None
    given = parse_qs(parts.query, keep_blank_values=True)
    unknown = [key for key in given if key not in _OPTIONS]
    if parts.scheme not in ("ws", "wss") or not host or port is None or unknown:
        raise SettingsError(
            f"{name!r:.200} is no policy server: write remote:ws://HOST:PORT, with ?mapping=FILE or &token=FILE"
        )
    mapping, token = (given[key][0] if key in given else None for key in _OPTIONS)
    address = urlunsplit((parts.scheme, parts.netloc, parts.path, "", ""))
    read = WireMapping() if mapping is None else WireMapping.read(Path(mapping))
    return address, read, None if token is None else token_of(Path(token))


def token_of(path: Path) -> str:
    """Return the token in a file, its first line.

    Raises:
        SettingsError: It cannot be read, or is shorter than 16 characters.
    """
    try:
        lines = path.read_text(encoding="ascii").split()
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(f"the token in {path} cannot be read: {error}") from error
    if not lines or len(lines[0]) < 16:
        raise SettingsError(f"the token in {path} must have 16 characters or more, in one line without spaces")
    return lines[0]
