"""Worker of policy_servers.py: `openpi-client` as a client, and its messages as those of a stand-in server.

Run as `openpi_worker.py client HOST PORT SIZE` or `openpi_worker.py server` with the Python of a virtual environment
that has the library. It does not import this package. Output, JSON: what the client got; or a line with the port.
"""

import importlib.metadata
import json
import sys

import numpy as np


def client(host, port, size):
    """Ask a server for chunks, and once with another request."""
    from openpi_client.action_chunk_broker import ActionChunkBroker
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    policy = WebsocketClientPolicy(host, int(port))
    observation = {"observation": np.linspace(-1.0, 1.0, int(size))}
    found = policy.infer(observation)
    broker = ActionChunkBroker(policy, len(found["actions"]))
    steps = [broker.infer(observation)["actions"].tolist() for _ in found["actions"]]
    try:
        policy.infer({"state": observation["observation"]})
        error = ""
    except RuntimeError as raised:
        error = str(raised)
    print(
        json.dumps(
            {
                "version": importlib.metadata.version("openpi-client"),
                "metadata": policy.get_server_metadata(),
                "actions": found["actions"].tolist(),
                "steps": steps,
                "error": error,
            }
        )
    )


def server():
    """Serve chunks that repeat the state of an ALOHA-style observation, written by openpi-client."""
    from openpi_client import msgpack_numpy
    from websockets.sync.server import serve

    def answer(connection):
        packer = msgpack_numpy.Packer()
        connection.send(packer.pack({"model": "stand-in"}))
        for message in connection:
            observation = msgpack_numpy.unpackb(message)
            assert observation["images"]["cam_high"].shape[0] == 3  # noqa: S101  # CHW
            state = np.asarray(observation["state"], dtype=np.float32)
            rows = state + np.linspace(0.0, 0.1, 25, dtype=np.float32)[:, None]
            connection.send(packer.pack({"actions": rows, "server_timing": {"infer_ms": np.float64(1.0)}}))

    with serve(answer, "127.0.0.1", 0, compression=None, max_size=None) as found:
        print(found.socket.getsockname()[1], flush=True)
        found.serve_forever()


if __name__ == "__main__":
    client(*sys.argv[2:]) if sys.argv[1] == "client" else server()
