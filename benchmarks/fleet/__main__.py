"""`python -m benchmarks.fleet`."""

import signal
import sys

from benchmarks.fleet.benchmark import main

if __name__ == "__main__":
    # Its processes and the journals in memory go with it, as at Ctrl-C.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    main()
