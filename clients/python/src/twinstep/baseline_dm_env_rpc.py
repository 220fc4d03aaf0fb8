# pyright: basic, reportMissingImports=false
"""Baseline of the bench: dm_env_rpc with one environment of the same shapes and without physics.

``python -m twinstep.baseline_dm_env_rpc`` is the server. It prints its port and terminates when its stdin closes.
"""

import subprocess
import sys
from collections.abc import Callable, Generator
from concurrent import futures
from contextlib import contextmanager

import grpc
import numpy as np
from dm_env_rpc.v1 import connection, dm_env_rpc_pb2, dm_env_rpc_pb2_grpc, tensor_utils

OBSERVATION, ACTION = 1, 1


class Servicer(dm_env_rpc_pb2_grpc.EnvironmentServicer):
    """Replies to every step with the same 45 floats."""

    def Process(self, request_iterator, context):  # noqa: N802
        """Handle one stream of requests and replies."""
        obs = np.zeros(45, np.float32)
        for request in request_iterator:
            tensor_utils.unpack_tensor(request.step.actions[ACTION])
            reply = dm_env_rpc_pb2.EnvironmentResponse()
            reply.step.state = dm_env_rpc_pb2.RUNNING
            reply.step.observations[OBSERVATION].CopyFrom(tensor_utils.pack_tensor(obs))
            yield reply


def serve() -> None:
    """Serve on a free port until stdin closes."""
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=2))
    dm_env_rpc_pb2_grpc.add_EnvironmentServicer_to_server(Servicer(), server)
    print(server.add_insecure_port("127.0.0.1:0"), flush=True)
    server.start()
    sys.stdin.read()
    server.stop(0)


@contextmanager
def remote_step() -> Generator[Callable[[], object], None, None]:
    """Yield a function that executes one step of an environment in another process."""
    server = subprocess.Popen(
        [sys.executable, "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert server.stdout is not None
    assert server.stdin is not None
    action = np.zeros(12, np.float32)

    def step() -> object:
        request = dm_env_rpc_pb2.StepRequest(requested_observations=[OBSERVATION])
        request.actions[ACTION].CopyFrom(tensor_utils.pack_tensor(action))
        return tensor_utils.unpack_tensor(client.send(request).observations[OBSERVATION])

    address = f"127.0.0.1:{int(server.stdout.readline())}"
    with grpc.insecure_channel(address) as channel, connection.Connection(channel) as client:
        yield step
    server.stdin.close()
    server.wait()


if __name__ == "__main__":
    serve()
