"""For how long what has come has waited for a merge that contains it."""

import threading
from collections import deque
from collections.abc import Callable

STEP = 1.0
"""s; what comes within it counts as one."""
MOST = 1000
"""Steps that are kept apart; then the newest one becomes longer."""


class Unmerged:
    """What has come is numbered from one. Thread-safe."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        # Last number of each step, and the time of its first one.
        self._steps: deque[tuple[int, float]] = deque()

    @property
    def seconds(self) -> float:
        """For how long the oldest of what is not merged has waited; 0 if everything is merged."""
        with self._lock:
            return self._clock() - self._steps[0][1] if self._steps else 0.0

    def came(self, number: int) -> None:
        """Something came, with the next number."""
        now = self._clock()
        with self._lock:
            if self._steps and (now < self._steps[-1][1] + STEP or len(self._steps) >= MOST):
                now = self._steps.pop()[1]
            self._steps.append((number, now))

    def merged(self, number: int) -> None:
        """The newest merge contains everything up to a number."""
        with self._lock:
            while self._steps and self._steps[0][0] <= number:
                self._steps.popleft()
