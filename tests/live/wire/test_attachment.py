"""A message's attachment: the publisher's number, the acknowledged flow, and what numbers tell of missed messages."""

from __future__ import annotations

import pytest
import zenoh

from omnibench.live.wire.messages import Flow, MissedMessages, flow_of, packed


def numbered(number: int, publisher: bytes = bytes(16), flow: Flow | None = None) -> zenoh.ZBytes:
    return zenoh.ZBytes(packed(number, publisher, flow))


class TestMissedMessages:
    def test_gaps_in_a_publishers_numbers_are_counted(self) -> None:
        missed = MissedMessages()
        assert [missed.take(numbered(number)) for number in (5, 6, 9, 10, 20)] == [0, 0, 2, 0, 9]
        assert missed.count == 2 + 9

    @pytest.mark.parametrize("flow", [None, (1, 2, 3, False)])
    def test_one_that_comes_after_all_is_not_missed_and_of_a_flow_one_that_comes_again_is_not_new(
        self, flow: Flow | None
    ) -> None:
        missed = MissedMessages()
        came = [missed.take(numbered(number, flow=flow)) for number in (1, 4, 2, 2, 4, 3)]
        again = 0 if flow is None else None
        assert came == [0, 2, 0, again, again, 0]
        assert missed.count == 0

    def test_publishers_have_numbers_of_their_own(self) -> None:
        missed = MissedMessages()
        for number in (1, 2, 3):
            missed.take(numbered(number))
            missed.take(numbered(100 * number, b"another publisher"[:16]))
        assert missed.count == 2 * 99

    @pytest.mark.parametrize("length", [0, 14, 33, 58, 90])
    def test_messages_of_other_programs_tell_nothing(self, length: int) -> None:
        missed = MissedMessages()
        messages = [None, zenoh.ZBytes(b"x" * length), zenoh.ZBytes(b"x" * length)]
        assert [missed.take(each) for each in messages] == [0, 0, 0]
        assert missed.count == 0
        assert flow_of(b"x" * length) is None

    def test_many_that_are_missed_are_counted_at_once(self) -> None:
        missed = MissedMessages()
        for number in range(1, 5_000_000, 50_000):
            missed.take(numbered(number))
        assert missed.count == 99 * 49_999


def test_a_flow_adds_to_an_attachment_what_ros_passes_over() -> None:
    plain, flow = packed(3, bytes(16)), packed(3, bytes(16), (7, 8, 9, True))
    assert (len(plain), flow_of(plain), flow_of(None)) == (33, None, None)
    assert flow[:8] == plain[:8]
    assert flow_of(flow) == (7, 8, 9, True)
