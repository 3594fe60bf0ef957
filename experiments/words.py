"""What a run is doing, in words, for people who watch it."""

from __future__ import annotations


def doing_in_words(step: str, soaked_again_s: float | None, *, goes_on: bool) -> str:
    """The step under way, in words, and what it waits for. soaked_again_s: how long a camera that was off has soaked
    again, None when it need not. goes_on: whether a soak goes on beyond its time."""
    if goes_on:
        step = f"{step}, and until the chamber has stayed in its band"
    if soaked_again_s is None:
        return step
    soaking = f"the camera was or may have been off and soaks again, for {soaked_again_s / 60:.0f} min so far"
    return f"{soaking}; then: {step}" if step else soaking
