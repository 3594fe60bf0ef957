"""A rule of the guard that holds a run while the laboratory is too warm."""

from typing import Any

from pydantic import Field

from thermostand.foundation.documents import Document
from thermostand.stand.config.guard_rule_plugins import GuardRule
from thermostand.stand.safety.fault import Fault, Readings, Watch, get_value


class Settings(Document):
    """Its keys below `guard.added.ambient_hot` of a stand's file."""

    limit_degC: float = Field(default=30.0, le=40)
    for_s: float = Field(default=0.0, ge=0)


def watches(settings: Settings, config: Any) -> list[Watch]:
    """Return what is judged every `guard.period_s`, how long it must object, and what is then done."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        value_degC = get_value(readings, "thermometers.laboratory")
        if value_degC > settings.limit_degC:
            return Fault("ambient_hot", f"the laboratory of {config.name} is {value_degC:.1f} degC")
        return None

    return [Watch(rule, settings.for_s, "hold")]


RULE = GuardRule("ambient_hot", "the laboratory is too warm", Settings, watches, "open a window")
