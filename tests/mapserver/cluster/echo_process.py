"""In place of the process between a server and Ray: answers with what it is asked."""

import os
import sys
import time
from multiprocessing.connection import Connection

from mapweave.mapserver.cluster.frames import MOST_FRAME, GatewayReply, GatewayRequest


def main() -> None:
    connection = Connection(int(sys.argv[1]))
    if sys.argv[2] == "nowhere":
        connection.send_bytes(GatewayReply(0, words="nothing listens at nowhere").packed())
        return
    if sys.argv[2] == "slow":
        time.sleep(2.0)
    connection.send_bytes(GatewayReply(int(sys.argv[3])).packed())
    while True:
        try:
            number, target, request = GatewayRequest.read(connection.recv_bytes())
        except EOFError:
            return
        if request == b"die":
            os._exit(1)
        if request == b"garbage":
            connection.send_bytes(b"no frame")
        elif request == b"too long":
            connection.send_bytes(bytes(MOST_FRAME + 1))
        elif request == b"fail":
            connection.send_bytes(GatewayReply(number, words="it failed").packed())
        elif request != b"silence":
            connection.send_bytes(GatewayReply(number, b"%d %s" % (target, request)).packed())


if __name__ == "__main__":
    main()
