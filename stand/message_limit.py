"""The stand's hub, on which a message that repeats is limited, and of which messages each one counts."""

from __future__ import annotations

from foundation.hub import Hub
from foundation.items import Event
from foundation.repeats import RepeatLimit

# These begin or end something that is counted, recorded or waited for: none may be withheld.
_COUNTING = frozenset(
    {
        "camera_equilibrium_lost",
        "camera_lost",
        "camera_supply_off",
        "capture_restarted",
        "clock_step",
        "command",
        "device_lost",
        "device_slow",
        "folder_lost",
        "frames_dropped",
        "frames_stopped",
        "held",
        "hold_ended",
        "hold_stays",
        "host_suspended",
        "not_confirmed_safe",
        "plan_changed",
        "prompt",
        "prompt_skipped",
        "readings_dropped",
        "readings_lost",
        "recording_lost",
        "released",
        "run.end",
        "run.resume",
        "run.start",
        "run_failed",
        "soak_restarted",
        "step_broken_off",
        "telemetry_not_saved",
        "warm_up_gap",
    }
)


def stand_hub() -> Hub:
    """A hub of a stand: of one warning or error, but for those that count, at most six in any hour are published."""
    return Hub(RepeatLimit(_counts))


def _counts(event: Event) -> bool:
    return event.kind in _COUNTING or event.data.get("action") in ("abort", "hold")
