"""Which frames are recorded whole, and what is kept of the others."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.readings import Frame
from thermostand.recording.format.images import decode_image, encode_image
from thermostand.recording.format.roi import RoiEncoder

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


def recorded(encoder, one):
    return decode_image("foxglove.CompressedImage", encoder(one))


def whole(encoder, frames):
    return [recorded(encoder, one).windows is None for one in frames]


@pytest.mark.parametrize(("dtype", "level_DN"), [(np.uint8, 180), (np.uint16, 3000)])
def test_the_windows_are_lossless_and_the_rest_is_the_median_of_the_last_whole_frame(dtype, level_DN):
    encoder = RoiEncoder(Finder())
    first = frame(0, dtype=dtype, level_DN=level_DN)
    np.testing.assert_array_equal(recorded(encoder, first).pixels, first.image)
    second = frame(1, dtype=dtype, level_DN=level_DN - 30)
    kept = recorded(encoder, second)
    inside = np.zeros(second.image.shape, bool)
    for x, y, width, height in WINDOWS:
        inside[y : y + height, x : x + width] = True
    np.testing.assert_array_equal(kept.windows, WINDOWS)
    np.testing.assert_array_equal(kept.pixels[inside], second.image[inside])
    assert set(kept.pixels[~inside]) == {level_DN}
    assert kept.pixels.dtype == dtype


def test_a_frame_is_left_as_it_was():
    encoder = RoiEncoder(Finder())
    encoder(frame(0))
    second = frame(1)
    before = second.image.copy()
    encoder(second)
    np.testing.assert_array_equal(second.image, before)
    assert second.windows is None


def test_a_whole_frame_comes_every_sixty_seconds_of_the_frames_time():
    finder = Finder()
    assert whole(RoiEncoder(finder), [frame(s) for s in (0, 0.5, 59.9, 60, 60.5, 119.9, 200, 201)]) == [
        *(True, False, False),
        *(True, False, False),
        *(True, False),
    ]
    assert len(finder.searched) == 3


def test_the_interval_is_the_callers():
    assert whole(RoiEncoder(Finder(), whole_every_s=2.0), [frame(s) for s in range(5)]) == [
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
    assert whole(RoiEncoder(Finder()), frames) == [True, False, True, False, True, False, True, False, True]


def test_a_clock_that_was_set_back_begins_with_a_whole_frame():
    assert whole(RoiEncoder(Finder()), [frame(1000), frame(10), frame(11)]) == [True, True, False]


def test_without_windows_frames_are_whole_and_the_search_waits_for_its_turn():
    finder = Finder(None)
    encoder = RoiEncoder(finder)
    assert whole(encoder, [frame(s) for s in range(5)]) == [True] * 5
    assert len(finder.searched) == 1
    finder.windows = WINDOWS
    assert whole(encoder, [frame(s) for s in (59, 60, 61)]) == [True, True, False]


def test_a_search_that_failed_leaves_the_frames_whole_and_is_reported_and_repeated():
    def fail(_):
        raise RuntimeError("no luck")

    encoder, reported = RoiEncoder(fail), []
    encoder.tell = reported.append
    assert whole(encoder, [frame(second) for second in (0, 1, 59)]) == [True] * 3
    assert reported == ["frames are recorded whole: the search for markers failed (RuntimeError: no luck)"]
    encoder(frame(60))
    assert len(reported) == 2


@pytest.mark.parametrize("window", [[0, 0, 101, 5], [-1, 0, 5, 5], [5, 5, 0, 5]])
def test_a_window_outside_the_image_is_a_programming_mistake(window):
    encoder = RoiEncoder(Finder(np.array([window], np.int32)))
    encoder(frame(0))
    with pytest.raises(ValueError, match="outside the image of 100 x 80 px"):
        encoder(frame(1))


def test_a_recorded_partial_frame_is_recorded_again_to_the_same_bytes():
    encoder = RoiEncoder(Finder())
    encoder(frame(0))
    second = frame(1)
    data = encoder(second)
    kept = decode_image("foxglove.CompressedImage", data)
    again = replace(second, image=kept.pixels, windows=kept.windows)
    assert RoiEncoder(Finder())(again) == data
    assert encode_image(again, "png") == data
