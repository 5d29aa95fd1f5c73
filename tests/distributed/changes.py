"""One short iteration of each way of training in `examples/rllib_two_agents.py`, on two nodes of one CPU each.

What it changed goes to the file that is named.
"""

import json
import os
import sys

# The example first: it sets what Ray reads when it is imported.
import rllib_two_agents as example  # isort: split

import numpy as np
import ray
from ray.cluster_utils import Cluster


def state_of(runner):
    """Node and process of a runner, and the weights that it acts by."""
    held = runner.get_state(components="rl_module")["rl_module"]
    held = held if hasattr(runner.module, "keys") else {"default_policy": held}
    return ray.get_runtime_context().get_node_id(), os.getpid(), held


def same(theirs, ours):
    """Whether all that a runner holds is what the learner holds. It has no use for the critic, which it may lack."""
    return len(theirs) > 0 and all(np.array_equal(np.asarray(value), ours[name]) for name, value in theirs.items())


def changes(config):
    config.training(train_batch_size_per_learner=400, minibatch_size=200, num_epochs=2)
    algorithm = config.build_algo()
    before = {name: dict(each) for name, each in algorithm.learner_group.get_weights().items()}
    algorithm.train()
    after = algorithm.learner_group.get_weights()
    runners = algorithm.env_runner_group.foreach_env_runner(state_of, local_env_runner=False)
    algorithm.stop()
    return {
        "nodes": sorted({node for node, _, _ in runners}),
        "processes": sorted({process for _, process, _ in runners}),
        "largest": {
            name: max(float(np.abs(after[name][key] - value).max()) for key, value in each.items())
            for name, each in before.items()
        },
        "finite": all(np.isfinite(value).all() for each in after.values() for value in each.values()),
        "runners have them": [all(same(held[name], after[name]) for name in after) for _, _, held in runners],
    }


def either():
    """As the comment in the example says."""
    keywords = {"policies": {"either"}, "policy_mapping_fn": lambda agent, episode, **keywords: "either"}
    return example.two_agents().multi_agent(**keywords)


if __name__ == "__main__":
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        ray.init(cluster.address)
        ways = {"two_agents": example.two_agents, "either": either, "joint_policy": example.joint_policy}
        found = {name: changes(way()) for name, way in ways.items()}
    finally:
        ray.shutdown()
        cluster.shutdown()
    with open(sys.argv[1], "w") as file:
        json.dump({"driver": os.getpid(), **found}, file)
