"""The fair queue against a model: a sender's things in order, senders in turn, room for who has little."""

from hypothesis import given
from hypothesis import strategies as st

from mapweave.wire.fair_queue import FairQueue

steps = st.lists(st.one_of(st.none(), st.tuples(st.sampled_from("abcd"), st.integers(0, 40))), max_size=200)


@given(steps, st.integers(1, 12), st.integers(1, 100))
def test_senders_take_turns_and_none_loses_its_share(
    steps: list[tuple[str, int] | None], most: int, most_bytes: int
):
    queue: FairQueue[int] = FairQueue(most, most_bytes)
    lanes: dict[str, list[tuple[int, int]]] = {}
    passed_over: dict[str, int] = {}
    for number, step in enumerate(steps):
        if step is None:
            if not lanes:
                assert len(queue) == 0
                continue
            sender, item = queue.pop()
            assert item == lanes[sender].pop(0)[0], "in order for each sender"
            passed_over.pop(sender, None)
            if not lanes[sender]:
                del lanes[sender]
            for other in lanes:
                passed_over[other] = passed_over.get(other, -1 if other == sender else 0) + 1
                assert passed_over[other] <= 3, "no more than once for each of the three others"
        else:
            sender, size = step
            taken = queue.put(sender, number, size)
            own = lanes.get(sender, [])
            senders = len(lanes) + (sender not in lanes)
            within = (len(own) + 1) * senders <= most
            within_bytes = (sum(s for _, s in own) + size) * senders <= most_bytes
            assert taken or not (within and within_bytes), "it has less than its share"
            everything = [s for lane in lanes.values() for _, s in lane]
            if len(everything) < most and sum(everything) + size <= most_bytes:
                assert taken, "there is room"
            if taken:
                lanes.setdefault(sender, []).append((number, size))
        assert len(queue) == sum(map(len, lanes.values()))
        assert all(queue.waiting(sender) == len(lanes.get(sender, [])) for sender in "abcd")


def test_one_that_floods_takes_no_more_than_the_queue():
    queue: FairQueue[int] = FairQueue(100, 10_000)
    assert sum(queue.put("flood", k, 1) for k in range(1000)) == 100
    assert sum(queue.put("r0", k, 1) for k in range(1000)) == 50
    assert [queue.pop()[0] for _ in range(6)] == ["flood", "r0"] * 3


def test_a_thing_may_take_the_place_of_its_senders_last():
    queue: FairQueue[str] = FairQueue(3, 100)
    for sender, item in (("a", "beacon 1"), ("b", "beacon 1"), ("a", "change")):
        assert queue.put(sender, item, 10)

    def beacon(item: str) -> bool:
        return item.startswith("beacon")

    assert not queue.put("a", "beacon 2", 10, replaces=beacon), "a change stays, and the queue is full"
    assert queue.put("b", "beacon 2", 10, replaces=beacon), "it needs no room"
    assert queue.waiting("b") == 1
    assert [queue.pop() for _ in range(3)] == [("a", "beacon 1"), ("b", "beacon 2"), ("a", "change")]
    assert len(queue) == 0
    assert queue.put("c", "one that takes it all", 100)
