"""Which frames are recorded whole, and what is kept of the others."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.readings import Frame
from thermostand.recording.format.images import MarkerWindows

START_NS = 1_767_290_400 * NS_PER_S
WINDOWS = np.array([[10, 20, 30, 30], [30, 40, 25, 20], [90, 0, 10, 80]], np.int32)  # two overlap, one ends at the edge


class Finder:
    """Gives `windows` and remembers what it was asked."""

    def __init__(self, windows: Any = WINDOWS):
        self.windows = windows
        self.searched = []

    def __call__(self, image):
        self.searched.append(image.shape)
        return self.windows


def frame(second, step_id="capture-1", shape=(80, 100), dtype: Any = np.uint8, level_DN=180):
    image = np.random.default_rng(int(second * 10)).normal(level_DN, 1.5, shape).round().astype(dtype)
    time_ns = START_NS + int(second * NS_PER_S)
    return Frame("camera.image", image, time_ns, 0.1, 0.0, 41.0, int(second), 1, step_id=step_id)


def whole(keep, frames):
    return [keep(one).windows is None for one in frames]


@pytest.mark.parametrize(("dtype", "level_DN"), [(np.uint8, 180), (np.uint16, 3000)])
def test_the_windows_are_lossless_and_the_rest_is_the_median_of_the_last_whole_frame(dtype, level_DN):
    keep = MarkerWindows(Finder())
    first = frame(0, dtype=dtype, level_DN=level_DN)
    np.testing.assert_array_equal(keep(first).image, first.image)
    second = frame(1, dtype=dtype, level_DN=level_DN - 30)
    kept = keep(second)
    inside = np.zeros(second.image.shape, bool)
    for x, y, width, height in WINDOWS:
        inside[y : y + height, x : x + width] = True
    np.testing.assert_array_equal(kept.windows, WINDOWS)
    np.testing.assert_array_equal(kept.image[inside], second.image[inside])
    assert set(kept.image[~inside]) == {level_DN}
    assert kept.image.dtype == dtype


def test_a_frame_is_left_as_it_was():
    keep = MarkerWindows(Finder())
    keep(frame(0))
    second = frame(1)
    before = second.image.copy()
    keep(second)
    np.testing.assert_array_equal(second.image, before)
    assert second.windows is None


def test_a_whole_frame_comes_every_sixty_seconds_of_the_frames_time():
    finder = Finder()
    assert whole(MarkerWindows(finder), [frame(s) for s in (0, 0.5, 59.9, 60, 60.5, 119.9, 200, 201)]) == [
        *(True, False, False),
        *(True, False, False),
        *(True, False),
    ]
    assert len(finder.searched) == 3


def test_the_interval_is_the_callers():
    assert whole(MarkerWindows(Finder(), whole_every_s=2.0), [frame(s) for s in range(5)]) == [
        True,
        False,
        True,
        False,
        True,
    ]


def test_a_new_step_size_type_or_channel_begins_with_a_whole_frame():
    frames = [
        frame(0),
        frame(1),
        frame(2, step_id="capture-2"),
        frame(3, step_id="capture-2"),
        frame(4, step_id="capture-2", shape=(90, 100)),
        frame(5, step_id="capture-2", shape=(90, 100)),
        frame(6, step_id="capture-2", shape=(90, 100), dtype=np.uint16),
        frame(7, step_id="capture-2", shape=(90, 100), dtype=np.uint16),
        replace(frame(8, step_id="capture-2", shape=(90, 100), dtype=np.uint16), channel="other.image"),
    ]
    assert whole(MarkerWindows(Finder()), frames) == [True, False, True, False, True, False, True, False, True]


def test_a_clock_that_was_set_back_begins_with_a_whole_frame():
    assert whole(MarkerWindows(Finder()), [frame(1000), frame(10), frame(11)]) == [True, True, False]


def test_without_windows_frames_are_whole_and_the_search_waits_for_its_turn():
    finder = Finder(None)
    keep = MarkerWindows(finder)
    assert whole(keep, [frame(s) for s in range(5)]) == [True] * 5
    assert len(finder.searched) == 1
    finder.windows = WINDOWS
    assert whole(keep, [frame(s) for s in (59, 60, 61)]) == [True, True, False]


def test_a_search_that_failed_leaves_the_frames_whole_and_is_reported_and_repeated():
    def fail(_):
        raise RuntimeError("no luck")

    keep, reported = MarkerWindows(fail), []
    keep.tell = reported.append
    assert whole(keep, [frame(second) for second in (0, 1, 59)]) == [True] * 3
    (reason,) = reported
    assert "(RuntimeError: no luck)" in reason
    keep(frame(60))
    assert len(reported) == 2


def test_a_recorded_partial_frame_stays_as_it_is():
    keep = MarkerWindows(Finder())
    keep(frame(0))
    partial = keep(frame(1))
    assert partial.windows is not None
    assert MarkerWindows(Finder())(partial) is partial
