"""A lock that readers share."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from mapweave.mapserver.retrieval.shared_lock import SharedLock
from tests.waiting import eventually


def test_readers_share_it_and_a_writer_has_it_alone():
    lock, inside, most = SharedLock(), {"read": 0, "write": 0}, {"read": 0, "write": 0}
    counting = threading.Lock()

    def enter(kind: str) -> None:
        with counting:
            inside[kind] += 1
            most[kind] = max(most[kind], inside[kind])
            assert inside["write"] == 0 or (inside["read"], inside["write"]) == (0, 1)

    def leave(kind: str) -> None:
        with counting:
            inside[kind] -= 1

    def work(seed: int) -> int:
        rng, done = np.random.default_rng(seed), 0
        for _ in range(100):
            draw = rng.random()
            if draw < 0.7:
                with lock.reading():
                    enter("read")
                    time.sleep(0.0002)
                    with lock.reading(), lock.writing(wait=False) as alone:
                        assert not alone
                    leave("read")
            else:
                with lock.writing(wait=draw < 0.9) as alone:
                    if alone:
                        enter("write")
                        with lock.writing() as again, lock.reading():
                            assert again
                        leave("write")
                        done += 1
        return done

    with ThreadPoolExecutor(6) as pool:
        written = sum(pool.map(work, range(6)))
    assert most["read"] > 1 and most["write"] == 1 and written > 90
    with lock.writing(wait=False) as alone:
        assert alone, "it is free at the end"


def test_a_waiting_writer_goes_before_later_readers():
    lock, order = SharedLock(), list[str]()

    def write() -> None:
        with lock.writing():
            order.append("write")

    def read() -> None:
        with lock.reading():
            order.append("read")

    with lock.reading():
        writer = threading.Thread(target=write)
        writer.start()
        eventually(lambda: lock._waiting)
        reader = threading.Thread(target=read)
        reader.start()
        with lock.reading():
            time.sleep(0.02)
        assert order == []
    writer.join(10)
    reader.join(10)
    assert order == ["write", "read"]


def test_a_reader_cannot_have_it_alone():
    lock = SharedLock()
    with lock.reading(), pytest.raises(RuntimeError, match="wait for itself"), lock.writing():
        pass
    with pytest.raises(ValueError, match="inside"), lock.writing():
        raise ValueError("inside")
    with lock.writing(wait=False) as alone:
        assert alone
