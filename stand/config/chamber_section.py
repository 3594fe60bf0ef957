"""The configuration's chamber section, and the guard's checks of the chamber that do not rely on its two probes."""

from __future__ import annotations

from pydantic import Field

from thermostand.foundation.documents import Document

BAND_K = 0.5  # the air is at its set-point: five digits of the regulator's display


class ChamberConfig(Document):
    """What is known of the chamber from commissioning; a third more or less does no harm.

    heater_W: the heater's power at full output. heat_capacity_Wh_K: of what it warms at once, air and liner: heater_W
    times the hours of a ramp at full output over the kelvins it made. granite_lag_s, camera_lag_s: how long the granite
    inside, and the camera, take for two thirds of a step of the air.
    """

    heater_W: float = Field(default=2000.0, gt=0, le=20_000)
    # Of the simulated chamber, as the lag below; drawn chambers differ from both by up to a third, and trip nothing.
    heat_capacity_Wh_K: float = Field(default=13.0, gt=0, le=1000)
    granite_lag_s: float = Field(default=4300.0, ge=60, le=100_000)
    camera_lag_s: float = Field(default=600.0, ge=10, le=10_000)


class HeatBalanceConfig(Document):
    """Heat that the probes do not show: while the regulator heats by half of its power or more, the regulator's value
    and the air must both rise, every two minutes, by rise_share of what the heat given would make of
    chamber.heat_capacity_Wh_K, and must not fall by 4 K. Good sessions: 0.4 at the least, and 1.5 K.
    """

    # A dead heater makes none. Of 200 dead heaters on 40 drawn chambers this found each first, within 245 s. Half or
    # twice as much would still tell them apart; twice leaves little for a heat capacity that is a third off.
    rise_share: float = Field(default=0.15, ge=0.01, le=1)


class GraniteCrosscheckConfig(Document):
    """The granite inside warms as if the air around it were warmer than a probe shows, by more than limit_K and 0.4 of
    what lies between that probe and the granite. Good sessions: 2.3 K beyond the share. Or, against the estimate of
    the last quarter of an hour, by change_K and the same share of what has changed.
    """

    # Chosen on 1,156 h of ten chambers drawn within +-30 %, in which nothing tripped. Half of it would trip on these;
    # twice finds a failure when the air is 4 K warmer.
    limit_K: float = Field(default=4.0, ge=1, le=10)
    change_K: float = Field(default=3.0, ge=1, le=10)


class CameraCrosscheckConfig(Document):
    """A cross-check as that by the granite, by the camera's own temperature: its excess over the air is learned when it
    has been on for settle_s, and must not grow. A camera that works more when it gives frames needs a wider limit_K.
    Good sessions: 2.6 K beyond half of what lies between air and camera."""

    settle_s: float = Field(default=2400.0, ge=60, le=14_400)
    # Half of it leaves 0.4 K above what good sessions reach.
    limit_K: float = Field(default=6.0, ge=1, le=20)


class SteadyStatePowerConfig(Document):
    """An output far from what the chamber has needed. Once the regulator has held its set-point within 2 K for
    settle_s, with the flap shut and the compressor as it is, means of 5 min may differ by limit_percent from those at
    set-points up to 3 K away, learned apart with and without the compressor. Good sessions: 10.6 %.
    """

    settle_s: float = Field(default=1800.0, ge=300, le=14_400)
    # Half of it leaves 2 % above what good sessions reach.
    limit_percent: float = Field(default=25.0, ge=5, le=80)


class StartupResponseConfig(Document):
    """The first time the regulator heats, by 40 % on average: its value and the air must both rise by rise_K within
    within_s, or its probe, its heater or its address is another chamber's."""

    within_s: float = Field(default=120.0, ge=30, le=600)
    # Five digits of the regulator's display.
    rise_K: float = Field(default=0.5, ge=0.1, le=5)
