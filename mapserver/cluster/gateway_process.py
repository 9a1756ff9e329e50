"""Process between a map server and Ray.

    python -m mapweave.mapserver.cluster.gateway_process FD ADDRESS SHARDS

Each shard is an actor that Ray starts again, as often as needed; all belong to this process and end with it.
"""

import os
import signal
import socket
import sys
import threading
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.mapserver.cluster.frames import MOST_FRAME, MOST_WORDS, GatewayReply, GatewayRequest
from mapweave.mapserver.cluster.gateway import WORK

LOOPBACK = "127.0.0.1"


def main() -> int:
    """Hand requests on until the other side closes."""
    descriptor, address, shards = int(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    # The server ends this; Ctrl+C in a terminal reaches both.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection = Connection(descriptor)
    try:
        ray = _joined(address)
    except Exception as error:  # noqa: BLE001 - whatever it is, the server says it and tries again
        connection.send_bytes(GatewayReply(0, words=f"{type(error).__name__}: {_words(error)}").packed())
        return 1
    from mapweave.mapserver.cluster.shard import ShardServer
    from mapweave.mapserver.cluster.work import answer_work

    shard = ray.remote(ShardServer).options(max_restarts=-1, num_cpus=0, scheduling_strategy="SPREAD")
    actors = [shard.remote() for _ in range(shards)]
    work = ray.remote(answer_work).options(num_cpus=1, max_retries=3, scheduling_strategy="SPREAD")
    connection.send_bytes(GatewayReply(int(ray.cluster_resources().get("CPU", 0))).packed())
    sending = threading.Lock()
    try:
        while True:
            request = GatewayRequest.read(connection.recv_bytes(MOST_FRAME))
            at = work if request.target == WORK else actors[request.target].call
            sent = at.remote(request.message)
            sent.future().add_done_callback(partial(_reply, connection, sending, request.number))
    except (EOFError, OSError, InvalidMessage):
        # Not sys.exit: with a head that is gone, Ray waits for it.
        threading.Timer(5.0, partial(os._exit, 0)).start()
        ray.shutdown()
        os._exit(0)


def _joined(address: str) -> Any:
    """Ray, as a driver in the cluster.

    Raises:
        ConnectionError: there is no cluster, or it does not let this server in.
    """
    if address != "auto" and not _listens(address):
        raise ConnectionError(f"nothing listens at {address}")
    import ray

    how: dict[str, Any] = {"namespace": "mapweave", "log_to_driver": False, "logging_level": "error"}
    if running := address if address != "auto" else _running():
        try:
            ray.init(address=running, **how)
        except ConnectionError as error:
            # Ray says nothing else when a cluster asks for a token.
            token = os.environ.get("RAY_AUTH_MODE") == "token"
            hint = (
                ""
                if token
                else "; if the cluster asks for a token, start the server with RAY_AUTH_MODE=token"
            )
            raise ConnectionError(f"{_words(error)}{hint}") from error
    else:
        ray.init(address="local", include_dashboard=False, _node_ip_address=LOOPBACK, **how)
    return ray


def _running() -> str:
    """Address of the cluster that runs on this machine; empty if none does."""
    # Ray leaves the address of its last cluster there, and waits two minutes for one that has ended.
    last = Path(os.environ.get("RAY_TMPDIR", "/tmp"), "ray", "ray_current_cluster")
    known = [os.environ.get("RAY_ADDRESS", ""), last.read_text().strip() if last.exists() else ""]
    return next((address for address in known if _listens(address)), "")


def _listens(address: str) -> bool:
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), 2.0).close()
    except (OSError, ValueError):
        return False
    return True


def _reply(connection: Connection, sending: threading.Lock, number: int, done: Future[bytes]) -> None:
    """Send an answer, or why there is none."""
    error = done.exception()
    reply = (
        GatewayReply(number, done.result()) if error is None else GatewayReply(number, words=_words(error))
    )
    # The other side may have closed: then this ends, too.
    with sending, suppress(OSError):
        connection.send_bytes(reply.packed())


def _words(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[-1][:MOST_WORDS]


if __name__ == "__main__":
    sys.exit(main())
