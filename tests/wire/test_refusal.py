"""Refusals as bytes: every word and number round-trips, and any bytes are read without harm."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.wire.bus import Reply
from mapweave.wire.messages import decode, encode
from mapweave.wire.refusal import LONGEST_PAUSE, MARK, decode_refusal, encode_refusal


@given(
    st.text(min_size=1).filter(lambda t: "\0" not in t and t.isprintable()), st.floats(0, 2 * LONGEST_PAUSE)
)
def test_refusals_come_back(reason: str, retry_after: float):
    reply = decode_refusal(encode_refusal(reason, retry_after))
    assert reply is not None
    assert reply.error == reason
    assert reply.retry_after == pytest.approx(min(retry_after, LONGEST_PAUSE), rel=1e-6, abs=1e-37)


def test_no_reason_is_said_in_a_word():
    assert encode_refusal("") == b"refused: refused"


@given(st.binary(max_size=40))
def test_any_input_is_a_refusal_or_none(data: bytes):
    assert decode_refusal(data) is None or data.startswith(MARK)
    reply = decode_refusal(MARK + data)
    assert isinstance(reply, Reply)
    assert reply.error and reply.error.isprintable()
    assert 0.0 <= reply.retry_after <= LONGEST_PAUSE


@pytest.mark.parametrize("reason", [b"line\nby\x1b[31m line", 10**6 * b"a", b"\n", b"\xff\xfe"])
def test_a_reason_can_be_passed_on_in_a_message(reason: bytes):
    """A robot may refuse with what no message may hold, and the record of missions holds its reason."""
    reply = decode_refusal(MARK + reason)
    assert reply is not None
    report = MissionReport(
        MissionOrder.new("r0", MissionKind.STOP, "anna"), MissionState.REFUSED, 0.0, reply.error
    )
    assert decode(encode(report), MissionReport) == report


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -1.0, 1e9, 0.0])
def test_a_pause_that_cannot_be_is_none(number: float):
    reply = decode_refusal(MARK + b"busy\0" + struct.pack("<f", number))
    assert reply == Reply(error="busy", retry_after=0.0)
