"""What is said of a part that was to be made safe, until it has confirmed that it is."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class NotConfirmed(BaseModel):
    """It is tried again until it confirms. name: of the device, or of its relay. since_ns: when its safe state was
    demanded. reason: why the last try did not confirm it, "" while the first one is under way. timer_s: of the relays
    of heat and cold, how long after since_ns the board's own timer has switched them off all the same; None where there
    is none.
    """

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    name: str
    since_ns: int
    reason: str = ""
    timer_s: float | None = None
