"""In place of the process between a server and Ray: answers with what it is asked."""

from __future__ import annotations

import os
import pickle
import sys
import time
from multiprocessing.connection import Connection


def main() -> None:
    connection = Connection(int(sys.argv[1]))
    if sys.argv[2] == "nowhere":
        connection.send_bytes(pickle.dumps((0, "nothing listens at nowhere")))
        return
    if sys.argv[2] == "slow":
        time.sleep(2.0)
    connection.send_bytes(pickle.dumps((int(sys.argv[3]), "")))
    while True:
        try:
            number, target, request = pickle.loads(connection.recv_bytes())
        except EOFError:
            return
        if request == b"die":
            os._exit(1)
        if request == b"fail":
            connection.send_bytes(pickle.dumps((number, b"", "it failed")))
        elif request != b"silence":
            connection.send_bytes(pickle.dumps((number, b"%d %s" % (target, request), "")))


if __name__ == "__main__":
    main()
