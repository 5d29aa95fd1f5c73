"""Worker of chunks.py: a policy server that plays a shipped policy's episodes in chunks, late.

Run as `chunk_server.py ENV_ID POLICY SEED LATENCY_S ACTIONS RATE_HZ`. Output: the address of the server.
"""

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from dual_ur10.policies.remote.policy_server import PolicyServer
from tests.policies.chunks.planned import Planned


class Late(Planned):
    """Chunks that take their time."""

    latency_s = 0.0

    def reset(self):
        """Go on with the same episode: it is reset at the connection, and by the client."""

    def chunk(self, observation, time_s):
        """Return a chunk after the latency."""
        time.sleep(self.latency_s)
        return super().chunk(observation, time_s)


def main(env_id: str, policy: str, seed: str, latency_s: str, actions: str, rate_hz: str) -> None:
    """Serve until the process ends."""
    longer = {"duration_s": 35.0} if "Sine" in env_id else {}  # so that the last chunks are whole
    source = Late(env_id, policy, int(seed), 1.0 / float(rate_hz), int(actions), **longer)
    source.latency_s = float(latency_s)
    metadata = {
        "env_id": env_id,
        "dt_s": source.dt_s,
        "action_space": source.action_mode,
        "endpoints": ["reset"],
        "time_key": "time_s",
    }
    server = PolicyServer(source, metadata, port=0)
    print(server.address, flush=True)
    server.run()


if __name__ == "__main__":
    main(*sys.argv[1:])
