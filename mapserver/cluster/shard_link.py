"""The server's side of one shard: what it must have, whether it has it, and a stand-in where it is gone.

A shard is *current* while it has every change. It is lost when it fails or does not answer in time; then it
is asked for its state until it answers. If that is what was last sent it is current again, else it is filled
from the nodes that the server has of its record. Until the first time that it is current, and when it is lost
for long, a stand-in in this process answers in its place.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future
from concurrent.futures import wait as wait_for
from typing import Any

import numpy as np

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.mapserver.cluster.gateway import ClusterGone
from mapweave.mapserver.cluster.messages import (
    Ask,
    ComparedNodes,
    Hello,
    Ids,
    Question,
    Reset,
    ShardChange,
    State,
    answer_to,
    decoded,
    encoded,
)
from mapweave.mapserver.cluster.shard import Shard
from mapweave.mapserver.retrieval.compared_landmarks import MOST_LANDMARKS

log = logging.getLogger(__name__)

Call = Callable[[bytes], "Future[bytes]"]
"""Sends a request to a shard. Requests arrive in the order of the calls, or not at all."""
AT_ONCE = 64
"""Nodes in one message: a shard takes about 10 ms for them, and a question waits no longer."""
MOST_UNACKNOWLEDGED = 16
"""Messages on the way to a shard; who sends more waits for it."""
STAND_IN_AFTER = 2.0
"""s; Ray restarts a killed actor in 2 s, on a busy machine in 7. A stand-in of 1000 nodes takes 0.2 s."""
PATIENCE = 30.0
"""s for a shard that is filled: it may fill smaller cells meanwhile."""
REACHED_WITHIN = 2.0
"""s for a lost shard to say what it has; while Ray restarts it, it says nothing."""
PAUSE = 0.2
"""s between two attempts to reach a lost shard."""


class ShardLink:
    """One shard of several. Its methods may be called from any thread."""

    def __init__(self, name: str, call: Call, timeout: float, stand_in_after: float = STAND_IN_AFTER) -> None:
        """Begin with no nodes; a stand-in answers until the shard is there.

        Args:
            name: for the log.
            call: sends a request to the shard.
            timeout: within which a question must be answered, s.
            stand_in_after: time after which a lost shard has a stand-in, s.
        """
        self.name, self.timeout = name, timeout
        self._call, self._stand_in_after = call, stand_in_after
        self._changed = threading.Condition(threading.RLock())
        self._nodes: dict[NodeId, Node] = {}
        self._landmarks = 0
        self._behind: dict[NodeId, None] = {}
        self._state: State | None = None
        self._current, self._closing = False, False
        self._stand_in: Shard | None = Shard()
        self._built: Shard | None = None
        self._lost_at = time.monotonic()
        self._unacknowledged: deque[Future[bytes]] = deque()
        self._thread = threading.Thread(target=self._keep, name=f"shard {name}", daemon=True)

    def __len__(self) -> int:
        return len(self._nodes)

    def __contains__(self, node_id: NodeId) -> bool:
        return node_id in self._nodes

    @property
    def current(self) -> bool:
        """Whether the shard itself answers, with all that it must have."""
        return self._current

    @property
    def answers(self) -> bool:
        """Whether it, or a stand-in, answers."""
        return self._current or self._stand_in is not None

    def start(self) -> None:
        """Begin to reach the shard."""
        self._thread.start()

    def close(self) -> None:
        """Stop; the shard itself is left as it is. A request to it ends with the gateway. Idempotent."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(PAUSE)

    # Change it.

    def change(self, nodes: Sequence[Node], gone: Collection[NodeId] = ()) -> None:
        """Put nodes, or replace them, and forget others."""
        for start in range(0, max(len(nodes), 1), AT_ONCE):
            self._change(nodes[start : start + AT_ONCE], gone if start == 0 else ())
        with self._changed:
            some = list(self._unacknowledged)[:-MOST_UNACKNOWLEDGED]
        wait_for(some, self.timeout)

    def _change(self, nodes: Sequence[Node], gone: Collection[NodeId]) -> None:
        with self._changed:
            news = [node for node in nodes if not _same(self._nodes.get(node.id), node)]
            removed = [node_id for node_id in dict.fromkeys(gone) if node_id in self._nodes]
            self._landmarks -= sum(self._searched(node_id) for node_id in removed)
            for node_id in removed:
                del self._nodes[node_id]
            before = dict.fromkeys(node.id for node in nodes)
            self._landmarks -= sum(map(self._searched, before))
            self._nodes.update((node.id, node) for node in nodes)
            self._landmarks += sum(map(self._searched, before))
            if not news and not removed:
                return
            for shard in (self._stand_in, self._built):
                if shard is not None:
                    shard.change(news, removed)
            if self._current:
                self._send(news, removed)
            else:
                self._behind.update(dict.fromkeys([*(node.id for node in news), *removed]))

    def _send(self, nodes: list[Node], gone: list[NodeId]) -> Future[bytes]:
        """Send the next change; what is lost of it is noticed."""
        assert self._state is not None
        state = self._state = State(self._state.incarnation, self._state.number + 1)
        sent = self._call(encoded(ShardChange(state, ComparedNodes.of(nodes), Ids.of(gone))))
        self._unacknowledged.append(sent)
        sent.add_done_callback(lambda done: self._acknowledged(done, state))
        return sent

    def _acknowledged(self, done: Future[bytes], state: State) -> None:
        with self._changed:
            if done in self._unacknowledged:
                self._unacknowledged.remove(done)
        if (error := done.exception()) is not None:
            self._lost(state, error)

    # Ask it.

    def wanted(self, hidden: Collection[NodeId]) -> int:
        """How many landmarks of its nodes are searched, without those of hidden nodes."""
        with self._changed:
            return self._landmarks - sum(map(self._searched, hidden))

    def _searched(self, node_id: NodeId) -> int:
        """How many landmarks of a node are searched; 0 if it is in another shard."""
        node = self._nodes.get(node_id)
        return 0 if node is None else min(len(node.landmarks), MOST_LANDMARKS)

    def ask(self, question: Question, message: bytes) -> Callable[[float], Any] | None:
        """Ask.

        Returns:
            Gives the answer when it is called with the time left, s; raises whatever went wrong. None if
            nothing answers now.
        """
        with self._changed:
            state, stand_in = self._state, self._stand_in
            sent = None
            if self._current and state is not None:
                sent = self._call(encoded(Ask(state, message)))
        if sent is not None and state is not None:
            return lambda left: self._answer(question, sent, state, left)
        if stand_in is None:
            return None
        return lambda left: stand_in.answer(question)

    def _answer(self, question: Question, sent: Future[bytes], state: State, left: float) -> Any:
        try:
            return answer_to(question, sent.result(max(left, 0.0)))
        except Exception as error:
            self._lost(state, error)
            raise

    def wait(self) -> bool:
        """Wait until it answers, itself or a stand-in; False if this is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self.answers or self._closing)
            return not self._closing

    # Lose it, and have it back.

    def _lost(self, state: State, error: BaseException) -> None:
        with self._changed:
            if not self._current or self._state is None or state.incarnation != self._state.incarnation:
                return
            if self._closing:
                return
            self._current, self._lost_at = False, time.monotonic()
            self._changed.notify_all()
        log.warning("shard %s is lost (%s): answers are partial until it is back", self.name, _words(error))

    def _keep(self) -> None:
        """Keep the shard, in a thread of its own: have the shard back whenever it is lost."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: not self._current or self._closing)
                if self._closing:
                    return
            try:
                self._restore()
            except Exception as error:  # noqa: BLE001 - whatever is wrong with the shard, it is tried again
                log.debug("shard %s: %s", self.name, error)
                # Without the cluster the shard is not back soon.
                self._stand_in_if_due(at_once=isinstance(error, ClusterGone))
                with self._changed:
                    self._changed.wait_for(lambda: self._closing, PAUSE)

    def _restore(self) -> None:
        """Bring the shard up to date; raises if it cannot be reached."""
        state = self._asked_state(Hello())
        with self._changed:
            same = state == self._state
        if not same:
            state = self._asked_state(Reset())
            with self._changed:
                self._state, self._behind = state, dict.fromkeys(self._nodes)
        began, count = time.monotonic(), len(self._behind)
        while True:
            with self._changed:
                some = list(self._behind)[:AT_ONCE]
                if self._closing:
                    return
                if not some:
                    self._current, self._stand_in, self._built = True, None, None
                    self._changed.notify_all()
                    break
                for node_id in some:
                    del self._behind[node_id]
                here = [node for node_id in some if (node := self._nodes.get(node_id)) is not None]
                gone = [node_id for node_id in some if node_id not in self._nodes]
                sent = self._send(here, gone)
            sent.result(PATIENCE)
        log.info(
            "shard %s is current: %d nodes, %d of them sent in %.1f s",
            self.name, len(self), count, time.monotonic() - began,
        )  # fmt: skip

    def _asked_state(self, request: Hello | Reset) -> State:
        answer = self._call(encoded(request)).result(max(self.timeout, REACHED_WITHIN))
        state: State = decoded(answer, State)
        return state

    def _stand_in_if_due(self, at_once: bool) -> None:
        """Let this process answer for a shard that is lost for long."""
        with self._changed:
            if self.answers or (not at_once and time.monotonic() - self._lost_at < self._stand_in_after):
                return
            shard = self._built = Shard()
            left = deque(self._nodes)
            back = self._call(encoded(Hello()))
        while left:
            with self._changed:
                if self._closing or (back.done() and back.exception() is None):
                    self._built = None
                    return
                some = [left.popleft() for _ in range(min(AT_ONCE, len(left)))]
                shard.change([self._nodes[node_id] for node_id in some if node_id in self._nodes])
        with self._changed:
            self._stand_in, self._built = shard, None
            self._changed.notify_all()
        log.warning("shard %s stays lost: this process answers for its %d nodes", self.name, len(self))


def _same(before: Node | None, node: Node) -> bool:
    """Whether a shard need not know of a node that is put again: it looks at descriptors only."""
    return before is not None and np.array_equal(before.landmarks.codes, node.landmarks.codes)


def _words(error: BaseException) -> str:
    return str(error).strip().splitlines()[-1][:200] if str(error).strip() else type(error).__name__
