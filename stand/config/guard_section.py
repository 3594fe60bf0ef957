"""The configuration's guard section: when the stand is made safe. A file cannot exceed the upper bounds."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, SerializeAsAny, field_validator, model_validator

from thermostand.foundation.documents import Document
from thermostand.stand.config.chamber_section import (
    CameraCrosscheckConfig,
    GraniteCrosscheckConfig,
    HeatBalanceConfig,
    StartupResponseConfig,
    SteadyStatePowerConfig,
)
from thermostand.stand.config.guard_rule_plugins import load_rule_settings


class HeaterOffConfig(Document):
    """Warming with the heater off. Two minutes after the heat was switched off the air may rise by rise_K, or end less
    than 5 K above laboratory and granite."""

    rise_K: float = Field(default=2.0, gt=0, le=20)


class CoolingConfig(Document):
    """Cooling in vain. While the compressor runs, the heater's output is 0 and the air is more than 2 K above
    laboratory and granite, it must fall by fall_K every window_s: a welded relay could balance the cold."""

    window_s: float = Field(default=600.0, gt=0, le=3600)
    fall_K: float = Field(default=0.5, gt=0, le=10)


class SensorsConfig(Document):
    """Thermometers against each other. A difference of the air's from the regulator's probe, or from a safety
    thermometer, above warn_K for warn_after_s is a warning; one of air and probe above trip_K for trip_after_s is a
    fault; a ramp at full power makes up to 5 K, and 3 K for 170 s. A temperature that moves by more than jump_K beyond
    its trend and its step within a few polls is suspect: a contact, a cable, not a temperature. drift_K: a change of
    the difference of two in the same air, at a set-point that is held again, is a warning.
    """

    warn_K: float = Field(default=3.0, gt=0, le=20)
    warn_after_s: float = Field(default=600.0, ge=0, le=3600)
    # Half of it would trip on a ramp at full power, and twice lets one of the two be wrong by 12 K.
    trip_K: float = Field(default=6.0, gt=0, le=20)
    trip_after_s: float = Field(default=120.0, ge=0, le=3600)
    jump_K: float = Field(default=2.0, gt=0, le=50)
    # A drift of 10 mK/h then shows after ten hours.
    drift_K: float = Field(default=0.1, gt=0, le=5)

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.warn_K > self.trip_K:
            raise ValueError(f"warn_K {self.warn_K} is above trip_K {self.trip_K}")
        return self


class ChannelLimits(Document):
    """What a channel has to stay within, in its own unit. Outside for after_s, or after so long without a reading,
    action follows: trip ends the run, hold waits for an operator, warn says so; without a reading trip is a hold.
    """

    lowest: float | None = None
    highest: float | None = None
    after_s: float = Field(default=60.0, ge=1, le=86400)
    action: Literal["trip", "hold", "warn"] = "warn"

    @model_validator(mode="after")
    def _limited(self) -> Self:
        if self.lowest is None and self.highest is None:
            raise ValueError("needs lowest, highest or both")
        if self.lowest is not None and self.highest is not None and self.lowest >= self.highest:
            raise ValueError(f"lowest {self.lowest:g} is not below highest {self.highest:g}")
        return self


class GuardConfig(Document):
    """When the guard makes the stand safe. The upper bounds are what the chamber survives: no file may lift them.

    panel_change_grace_s: how long the unit and this program may differ about running, permits and the set-point, as
    when somebody changes them at its panel. flap_open_s: how long the flap may be open outside captures;
    flap_capture_s: in all. disk_low_s: how long the recorder may refuse frames. camera_temperature_s: how long a
    powered camera with frames to come may have no temperature.
    pause_limit_h: how long an operator's pause, or a prompt that nobody answers, may keep the chamber at its set-point,
    hours. overrides: paths of values outside the ranges of safe_ranges.py, which are otherwise refused.
    channels: limits for what any device measures, by its channel, as `lab.pressure`.
    added: settings of rules that other packages add, by their names. safe_limit_s: how long, at the end of a run, it is
    tried to have every actuator confirm that it is safe.
    heat_max_Wh_per_h: within any hour; good sessions took up to 900.
    """

    period_s: float = Field(default=1.0, gt=0, le=10)
    # Fifteen kelvins below what the chamber survives.
    max_air_degC: float = Field(default=65.0, le=80)
    max_granite_degC: float = Field(default=60.0, le=80)
    max_camera_degC: float = Field(default=85.0, le=100)
    # Three polls of the slowest kind. Twice as long, the heater runs for 30 s without a temperature.
    stale_after_s: float = Field(default=15.0, gt=0, le=120)
    # With all software gone the relay board ends the heat after this: 8 Wh at 2 kW, 0.6 K of a chamber of 13 Wh/K.
    heater_hold_s: float = Field(default=15.0, ge=2.0, le=60.0)
    heater_renew_s: float = Field(default=5.0, gt=0)
    heater_off: HeaterOffConfig = HeaterOffConfig()
    cooling: CoolingConfig = CoolingConfig()
    sensors: SensorsConfig = SensorsConfig()
    # Sessions of drawn chambers with large steps within an hour took 1413 to 1416 Wh, which trips. Half of it would
    # trip on good ones, and twice is more than 2 kW can give.
    heat_max_Wh_per_h: float = Field(default=1400.0, gt=0, le=20_000)
    heat_balance: HeatBalanceConfig = HeatBalanceConfig()
    granite_crosscheck: GraniteCrosscheckConfig = GraniteCrosscheckConfig()
    camera_crosscheck: CameraCrosscheckConfig = CameraCrosscheckConfig()
    steady_state_power: SteadyStatePowerConfig = SteadyStatePowerConfig()
    startup_response: StartupResponseConfig = StartupResponseConfig()
    panel_change_grace_s: float = Field(default=30.0, ge=1, le=600)
    flap_open_s: float = Field(default=300.0, gt=0, le=36000)
    # 45 min. Round number; nothing was measured.
    flap_capture_s: float = Field(default=2700.0, gt=0, le=36000)
    # Round number; nothing was measured.
    disk_low_s: float = Field(default=900.0, ge=0, le=36000)
    camera_temperature_s: float = Field(default=60.0, gt=0, le=36000)
    overrides: tuple[str, ...] = ()
    # Round number; nothing was measured.
    pause_limit_h: float = Field(default=12.0, gt=0, le=24)
    channels: dict[str, ChannelLimits] = Field(default_factory=dict[str, ChannelLimits])
    added: dict[str, SerializeAsAny[Document]] = Field(default_factory=dict)
    # Round number; nothing was measured.
    safe_limit_s: float = Field(default=600.0, ge=1, le=3600)

    _added = field_validator("added", mode="before")(load_rule_settings)

    @model_validator(mode="after")
    def _check_renewal(self) -> Self:
        if self.heater_renew_s * 2 > self.heater_hold_s:
            raise ValueError("heater_renew_s must be at most half of heater_hold_s, or one lost command cuts the heat")
        if self.period_s + self.heater_renew_s >= self.heater_hold_s:  # renewals fall on the guard's own looks
            raise ValueError("period_s + heater_renew_s must be below heater_hold_s, or the heat drops out in between")
        return self
