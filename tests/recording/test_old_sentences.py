"""Events recorded before there was data get that of their sentence, where they are decoded and nowhere else."""

import pytest

from foundation.items import Event
from recording.format.messages import decode_event, encode_event
from recording.format.restarts import restarted_step
from recording.reading.gaps import reported_blocks


def decoded(kind: str, text: str, data: dict[str, object] | None = None) -> Event:
    return decode_event(encode_event(Event(0, "warning", kind, text, data or {})), 0)


def test_a_capture_that_was_restarted_is_named():
    old = decoded(
        "capture_restarted", "capture warm-up-3 begins anew, it was interrupted for 90 s; its 4 frames so far"
    )
    assert restarted_step(old) == "warm-up-3"


@pytest.mark.parametrize(
    ("text", "blocks"),
    [
        ("frames lost: 1 (block 9 of step a), 4 in all; slow", [range(9, 10)]),
        (
            "frames lost: 5 (blocks 12 to 14, 17 of step a and block 104), 5 in all; full",
            [range(12, 15), range(17, 18), range(104, 105)],
        ),
        ("the disk is too slow", []),
    ],
)
def test_lost_blocks_are_counted(text: str, blocks: list[range]):
    assert reported_blocks([decoded("frames_dropped", text)]) == blocks


def test_a_home_check_has_its_residual():
    old = decoded("home_residual_large", "linear: home was at -0.00400 mm (-3.20 steps)")
    assert old.data == {"axis": "linear", "residual": -0.004, "unit": "mm"}


def test_data_that_were_recorded_count_whatever_the_sentence_says():
    event = decoded("frames_dropped", "frames lost: 1 (block 9 of step a)", {"blocks": [[1, 2]]})
    assert reported_blocks([event]) == [range(1, 3)]


@pytest.mark.parametrize("blocks", ["9", [[1]], [[2, 1]], [["1", 2]], [[-1, 2]], [[1, 2**80]], {"1": 2}, None])
def test_blocks_that_are_no_pairs_of_numbers_are_none(blocks: object):
    assert reported_blocks([Event(0, "error", "frames_dropped", "", {"blocks": blocks})]) == []
