"""Policy servers and clients of openpi's protocol against `openpi-client`, in both directions.

    python benchmarks/policy_servers.py --python PYTHON [--json FILE]

`PYTHON` is that of a virtual environment with the library, as `make clients` makes it.

client: `openpi-client` asks our server for a shipped policy's action, alone and through its chunk broker, and with a
    wrong request.
server: Our client runs Handover with chunks of a stand-in server whose messages `openpi-client` reads and writes, by
    the mapping of docs/how-to/policy-servers.md for ALOHA-style keys.
"""

import argparse
import json
import pathlib
import re
import subprocess
import tempfile

import numpy as np

from dual_ur10.policies import load, make, rollout
from dual_ur10.policies.serving import server_of

FOLDER = pathlib.Path(__file__).parent
WORKER = FOLDER / "workers" / "openpi_worker.py"
PAGE = FOLDER.parent / "docs" / "how-to" / "policy-servers.md"
ENV_ID, OPTIONS, SIZE = "DualUR10/SineTracking-v0", {"action_latency_ticks": 5}, 94
CAMERAS = ("front", "left/wrist", "right/wrist")
WAIT_S = 120.0


def client(python):
    """Return what openpi-client got of our server."""
    with server_of("learned", ENV_ID, OPTIONS, port=0) as server:
        host, port = server.address.removeprefix("ws://").rsplit(":", 1)
        words = [python, "-P", str(WORKER), "client", host, port, str(SIZE)]
        text = subprocess.run(words, capture_output=True, text=True, timeout=WAIT_S, check=True, env={}).stdout
    found = json.loads(text.splitlines()[-1])
    own = load("learned", ENV_ID, **OPTIONS)(np.linspace(-1.0, 1.0, SIZE))
    same = np.array_equal(np.array(found["actions"], dtype=np.float32), own[None])
    return {
        "version": found["version"],
        "same_action": bool(same and found["steps"] == found["actions"]),
        "env_id": found["metadata"]["env_id"],
        "error": found["error"].splitlines()[-1],
    }


def server(python):
    """Return what our client made of chunks that openpi-client wrote."""
    text = dict(re.findall(r"```toml\n# (\w+)\.toml\n(.*?)```", PAGE.read_text(), re.DOTALL))["aloha"]
    words = [python, "-P", str(WORKER), "server"]
    with (
        tempfile.NamedTemporaryFile("w", suffix=".toml") as mapping,
        subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env={}) as process,
    ):
        try:
            mapping.write(text)
            mapping.flush()
            name = f"remote:ws://127.0.0.1:{process.stdout.readline().strip()}?mapping={mapping.name}"
            env, policy = make(
                name, "Handover", observation="both", cameras=CAMERAS, width=64, height=48, max_episode_steps=100
            )
            record = rollout(env, policy, seed=0)
            env.close()
            policy.close()
        finally:
            process.kill()
    return {
        "metadata": policy.source.metadata.model_dump(exclude_defaults=True),
        "splices": policy.splices,
        "steps": record.steps,
        "ended_by": record.ended_by,
        "moved_rad": float(np.abs(record.q_rad[-1] - record.q_rad[0]).max()),
    }


def main() -> None:
    """Try both, and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", required=True, help="Python that has openpi-client")
    parser.add_argument("--json", type=pathlib.Path)
    asked = parser.parse_args()
    found = {"client": client(asked.python), "server": server(asked.python)}
    text = json.dumps(found, indent=1)
    print(text)
    if asked.json:
        asked.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
