"""A Ray cluster of two nodes on this machine, for tests in which one of them dies."""

import socket

AGENTS = ("metrics_agent_port", "metrics_export_port", "dashboard_agent_listen_port", "runtime_env_agent_port")
"""A node's helpers. Where they choose ports themselves, Ray waits for them no longer than 30 s, which is too short for
a busy machine."""


def started_nodes():
    """Two nodes with a CPU each; shut them down."""
    from ray.cluster_utils import Cluster

    nodes = Cluster()
    nodes.add_node(num_cpus=1, include_dashboard=False, **_free_ports("gcs_server_port", *AGENTS))
    nodes.add_node(num_cpus=1, **_free_ports(*AGENTS))
    return nodes


def _free_ports(*names):
    sockets = [socket.create_server(("", 0)) for _ in names]
    ports = {name: taken.getsockname()[1] for name, taken in zip(names, sockets, strict=True)}
    for taken in sockets:
        taken.close()
    return ports
