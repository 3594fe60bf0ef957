"""The configuration's chamber section, and the guard's checks of the chamber that do not rely on its two probes."""

from __future__ import annotations

from pydantic import Field

from thermostand.foundation.documents import Document


class ChamberConfig(Document):
    """What is known of the chamber from commissioning; a third more or less does no harm.

    heater_W: the heater's power at full output. heat_capacity_Wh_K: of what it warms at once, air and liner: heater_W
    times the hours of a ramp at full output over the kelvins it made. granite_lag_s, camera_lag_s: how long the granite
    inside, and the camera, take for two thirds of a step of the air.
    """

    heater_W: float = Field(default=2000.0, gt=0, le=20_000)
    heat_capacity_Wh_K: float = Field(default=13.0, gt=0, le=1000)
    granite_lag_s: float = Field(default=4300.0, ge=60, le=100_000)
    camera_lag_s: float = Field(default=600.0, ge=10, le=10_000)


class HeatFeltConfig(Document):
    """Heat that the probes do not show. While the output is at or above output_percent, neither the regulator's value
    nor the air may fall by fall_K; once that has lasted for settle_s, each must rise in every window_s by rise_share of
    what the heat given would make of chamber.heat_capacity_Wh_K. Good nights: 1.5 K and, at the least, 0.4.
    """

    output_percent: float = Field(default=50.0, gt=0, le=90)
    fall_K: float = Field(default=4.0, ge=1, le=10)
    rise_share: float = Field(default=0.15, ge=0.01, le=1)
    window_s: float = Field(default=120.0, ge=30, le=600)
    settle_s: float = Field(default=60.0, ge=0, le=600)


class GraniteFeelsConfig(Document):
    """The granite inside warms as if the air around it were warmer than a probe shows, by more than limit_K and share
    of what lies between that probe and the granite; means of window_s. Good nights: 2.3 K beyond the share. Or, against
    what was felt lately, over change_s, by change_K and the same share of what has changed.
    """

    window_s: float = Field(default=60.0, ge=30, le=600)
    limit_K: float = Field(default=4.0, ge=1, le=10)
    share: float = Field(default=0.4, ge=0, le=0.8)
    change_K: float = Field(default=3.0, ge=1, le=10)
    change_s: float = Field(default=900.0, ge=60, le=3600)


class CameraFeelsConfig(Document):
    """As the granite, by the camera's own temperature: its excess over the air is learned when it has been on for
    settle_s, and must not grow. A camera that works more when it gives frames needs a wider limit_K. Good nights:
    2.6 K beyond the share. A temperature that has not changed for window_s while the air went still_air_K is doubted.
    """

    settle_s: float = Field(default=2400.0, ge=60, le=14_400)
    window_s: float = Field(default=120.0, ge=30, le=900)
    limit_K: float = Field(default=6.0, ge=1, le=20)
    share: float = Field(default=0.5, ge=0, le=0.8)
    still_air_K: float = Field(default=3.0, ge=1, le=10)


class NeededOutputConfig(Document):
    """An output far from what the chamber has needed. Once the regulator has held its set-point within band_K for
    settle_s, with the flap shut and the compressor as it is, the means of mean_s may differ by limit_percent from
    those at set-points up to near_K away, learned apart with and without the compressor. Good nights: 10.6 %.
    """

    settle_s: float = Field(default=1800.0, ge=300, le=14_400)
    mean_s: float = Field(default=300.0, ge=60, le=3600)
    limit_percent: float = Field(default=25.0, ge=5, le=80)
    band_K: float = Field(default=2.0, ge=0.5, le=5)
    near_K: float = Field(default=3.0, ge=0.5, le=20)


class FrozenConfig(Document):
    """A thermometer in steps of step_K or less that is exactly constant for after_s while the regulator's output works
    is held; the camera's own temperature that is exactly constant still camera_after_s after the air has gone
    air_moves_K is stale.
    """

    after_s: float = Field(default=300.0, ge=60, le=900)
    step_K: float = Field(default=0.02, gt=0, le=0.1)
    camera_after_s: float = Field(default=600.0, ge=60, le=3600)
    air_moves_K: float = Field(default=3.0, ge=1, le=20)


class FirstHeatConfig(Document):
    """The first time the regulator heats, by output_percent on average: its value and the air must both rise by rise_K
    within within_s, or its probe, its heater or its address is another chamber's."""

    within_s: float = Field(default=120.0, ge=30, le=600)
    output_percent: float = Field(default=40.0, ge=5, le=90)
    rise_K: float = Field(default=0.5, ge=0.1, le=5)
