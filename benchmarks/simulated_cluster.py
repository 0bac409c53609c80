"""A Ray cluster simulated on this machine, of a head without cores and nodes of one core, to be killed and frozen."""

import contextlib
import os
import signal
import subprocess


class Simulated:
    """Three nodes at most, whatever was done to them before."""

    def __init__(self):
        from ray.cluster_utils import Cluster

        self.cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        self.nodes, self.frozen, self.stopped = [], [], []

    @property
    def address(self):
        return self.cluster.address

    def whole(self, number=3):
        """So many nodes that answer, or more, in place of those that are dead or frozen."""
        for pid in self.stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        for node in self.frozen:
            self.cluster.remove_node(node, allow_graceful=False)
        self.stopped.clear()
        self.frozen.clear()
        self.nodes += [self.cluster.add_node(num_cpus=1) for _ in range(number - len(self.nodes))]

    def kill(self):
        """The first node, and all that runs there."""
        self.cluster.remove_node(self.nodes.pop(0), allow_graceful=False)

    def freeze(self):
        """The last node: its processes are there and do nothing."""
        self.frozen.append(node := self.nodes.pop())
        (raylet,) = (each.process.pid for each in node.all_processes["raylet"])
        children = subprocess.run(["pgrep", "-P", str(raylet)], capture_output=True, text=True, check=True).stdout
        for pid in (raylet, *map(int, children.split())):
            os.kill(pid, signal.SIGSTOP)
            self.stopped.append(pid)

    def shutdown(self):
        self.whole(0)
        self.cluster.shutdown()
