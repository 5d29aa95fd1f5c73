"""Evaluate a policy with Wilson's interval: python examples/evaluate_checkpoint.py [POLICY] [EPISODES]."""

import sys

from dual_ur10.policies import evaluate

policy = sys.argv[1] if len(sys.argv) > 1 else "learned"  # or the folder of a checkpoint
episodes = int(sys.argv[2]) if len(sys.argv) > 2 else 300

keywords = {"randomization": "mild", "action_latency_ticks": 5}  # as it was trained
found = evaluate("DualUR10/SineTracking-v0", policy, episodes=episodes, env_kwargs=keywords)
low, high = found.interval
print(f"{policy}: {found.successes} of {episodes} succeed; 95 % interval {100 * low:.1f} to {100 * high:.1f} %")
