"""The hazards of a stand: what must not happen, how it is found, and what limits it when the computer is dead.

docs/reference/hazards.md is made of it, with times that `test_hazards.py` measures by night (hazards_measured.json):

    python -m tests.system.hazards > docs/reference/hazards.md
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

MEASURED = Path(__file__).with_name("hazards_measured.json")

Severity = Literal["fire", "damage", "lost session", "wrong data"]


@dataclass(frozen=True, slots=True)
class Trial:
    """`fault` = `value` while the chamber has been at start_degC for soak_s; then_degC: the next set-point, ordered at
    that moment. within_s: limit to find it. before: the fault is there when the chamber is started."""

    fault: str
    value: object
    start_degC: float = 26.0
    soak_s: float = 60.0
    within_s: float = 120.0
    then_degC: float | None = None
    before: bool = False

    @property
    def name(self) -> str:
        return f"{self.fault}={json.dumps(self.value)}"


@dataclass(frozen=True, slots=True)
class Hazard:
    """action: the unsafe control action. faults: of the simulator, as patterns. rules: of the guard that find it.
    dead: what limits it while no program runs. tests: that show it. trials: in which its times are measured."""

    action: str
    effect: str
    severity: Severity
    faults: tuple[str, ...]
    rules: tuple[str, ...]
    dead: str
    tests: tuple[str, ...]
    trials: tuple[Trial, ...] = ()


_CUT_OUT = "the hard-wired cut-out; the relay board's timer, after 15 s"
_TIMER = "the relay board's timer, after 15 s"
_NOTHING_HEATS = "nothing heats, cools or moves then"

HAZARDS = (
    Hazard(
        "heat although the air is warmer than its thermometers say",
        "camera and target too hot; in the end the cut-out",
        "fire",
        (
            "regulator.stuck_pv_degC", "regulator.pv_*", "regulator.probe_*", "regulator.sensor_break",
            "regulator.ad_error", "thermometer.*", "thermometers.*", "chamber.stuck_degC",
        ),
        (
            "over_temperature", "sensors_disagree", "air_warmer_than_shown", "too_much_heat",
            "no_heat_response", "output_not_as_needed", "sensor_bad", "sensor_missing", "sensor_stale", "sensor_stuck",
            "sensor_drifts", "sensor_implausible", "sensor_outside", "sensor_noisy", "sensor_jumped",
        ),
        _CUT_OUT,
        ("system/test_probes_wire.test_the_air_stays_below_its_limit_in_every_failure",),
        (
            Trial("thermometer.offset_K", {"granite_inside": 40.0}),
            Trial("thermometer.offset_K", {"air": 9.0}, 28.0, 20.0, 300.0, before=True),
            Trial("thermometer.open", "air", 24.0, 20.0),
            Trial("regulator.stuck_pv_degC", 20.0, 20.0, 1200.0, 300.0, 45.0),
        ),
    ),
    Hazard(
        "heat that nobody has commanded",
        "the air warms without end",
        "fire",
        ("heater.welded_share", "relays.welded", "relays.lost_writes"),
        ("warming_while_off", "heat_uncontrolled"),
        "the hard-wired cut-out",
        ("system/test_guard_wire.test_a_fault_trips_its_rule_in_time_and_the_stand_is_safe",),
        (Trial("heater.welded_share", 0.7, 30.0, 1200.0, 900.0), Trial("relays.lost_writes", True)),
    ),
    Hazard(
        "heat or cold switched on by another master",
        "heat without a guard",
        "fire",
        (),
        ("switched_on_without_permission",),
        "the hard-wired cut-out",
        ("system/test_relay_keeper.test_another_master_that_switches_heat_on_twice_without_permission_holds_the_run",),
    ),
    Hazard(
        "heat goes on after its program was stopped, killed or hung",
        "heat without a guard",
        "fire",
        ("relays.no_timer", "relays.no_rearm", "heat_module.refreshed_by"),
        ("guard_failed", "device_fault"),
        _TIMER + "; a board whose timer fails the test at the start is refused",
        (
            "system/test_dead_man_model.test_heat_ends_after_the_last_look_of_a_guard_in_every_order_of_events",
            "system/test_relay_keeper.test_a_board_that_is_suited_passes_the_test_of_its_timer",
        ),
    ),
    Hazard(
        "another set-point, output or law than what was commanded",
        "the chamber goes elsewhere",
        "damage",
        (
            "regulator.set_point_*", "regulator.acting_degC", "regulator.ramp_K_per_min", "regulator.manual_percent",
            "regulator.autotune", "regulator.decimals", "regulator.compoway", "regulator.restart",
            "chamber.set_point_degC", "chamber.program_degC", "chamber.bank", "chamber.clamps",
            "chamber.ignores_writes", "chamber.protected", "chamber.humidity", "heat_module.*",
        ),
        ("device_fault",),
        _TIMER + ", and the regulator's own limits",
        ("system/test_guard_wire.test_a_fault_trips_its_rule_in_time_and_the_stand_is_safe",),
        (Trial("regulator.set_point_degC", 45.0), Trial("regulator.manual_percent", 30.0)),
    ),
    Hazard(
        "heat that does not arrive where it is measured",
        "the regulator asks for more; heat arrives elsewhere",
        "damage",
        ("heater.cut_out",),
        ("first_heat", "no_heat_response"),
        _CUT_OUT,
        ("system/test_guard_wire.test_a_fault_trips_its_rule_in_time_and_the_stand_is_safe",),
        (Trial("heater.cut_out", True, 22.0, 60.0, 900.0, 50.0),),
    ),
    Hazard(
        "the compressor starts without its rest, or runs in vain",
        "the compressor fails",
        "damage",
        ("relays.brown_out",),
        ("cooling_in_vain",),
        "its rest is kept over restarts in a file of the stand",
        ("system/test_relay_keeper.test_a_compressor_whose_relay_is_dropped_by_somebody_else_has_stopped_and_rests",),
    ),
    Hazard(
        "the regulator stops, or its permission does not come",
        "the chamber drifts to the laboratory's temperature",
        "lost session",
        ("regulator.stop_key", "chamber.stop_key", "chamber.restart", "chamber.alarm"),
        ("regulator_stopped", "permit_missing"),
        _NOTHING_HEATS,
        ("system/test_guard_wire.test_a_fault_trips_its_rule_in_time_and_the_stand_is_safe",),
        (Trial("regulator.stop_key", True),),
    ),
    Hazard(
        "a device is commanded that does not answer, or answers late or damaged",
        "its state is not known",
        "damage",
        (
            "bus.*", "regulator.silent", "relays.silent*", "chamber.byte_by_byte", "chamber.cut", "chamber.delay_s",
            "chamber.drop", "chamber.echo", "chamber.flip", "chamber.flow_control", "chamber.garbled",
            "chamber.hangs_up", "chamber.junk", "chamber.late*", "chamber.mixed", "chamber.mute", "chamber.silent",
            "chamber.swallows_first", "chamber.unplugged",
        ),
        ("sensor_bad", "device_lost"),
        _TIMER,
        ("system/test_failure_table.test_each_fault_is_seen_as_what_it_is_and_its_device_is_back_when_it_is_mended",),
        (Trial("bus.silent", True), Trial("relays.silent", True)),
    ),
    Hazard(
        "the camera's supply is on though the camera is too warm",
        "the camera fails",
        "damage",
        ("camera.sensor_degC",),
        ("over_temperature", "camera_temperature_bad"),
        "the camera's own cut-off, where it has one; heat ends by the timer",
        ("system/test_guard_run.test_a_fault_of_the_heat_or_its_sensors_ends_the_run_and_only_an_operator_may_resume_it",),
    ),
    Hazard(
        "the flap is open outside captures",
        "dew on camera and target; the chamber is not held",
        "damage",
        ("flap.*",),
        ("flap_open", "dew"),
        "the flap stays as it is",
        ("system/test_guard_wire.test_a_flap_that_is_left_open_holds_the_stand_and_is_closed",),
    ),
    Hazard(
        "a stage moves on in an alarm, beyond its end, or after a stop",
        "a crash of the target; a hand is caught",
        "damage",
        ("linear.*", "rotary.*", "axis.alarm"),
        ("stage_alarm", "settings_changed", "device_fault"),
        "the controller ends its move and has its limit switches",
        ("system/test_stage_safety.test_make_safe_between_the_two_parts_of_a_move_cancels_the_second",),
        (Trial("axis.alarm", "rotary"),),
    ),
    Hazard(
        "heat that is not recorded",
        "a session that cannot be used; nobody knows what was done",
        "lost session",
        (),
        ("not_recorded", "recording_ended", "disk_low", "folder_lost"),
        _NOTHING_HEATS,
        ("system/test_guard_run.test_a_full_disk_trips_after_its_time_and_a_reset_frees_no_space",),
    ),
    Hazard(
        "a run waits for ever with the stand warm",
        "hours of heat for nothing",
        "lost session",
        (),
        ("paused_too_long",),
        _NOTHING_HEATS,
        ("system/test_paused.test_a_pause_that_lasts_too_long_is_made_safe_and_held",),
    ),
    Hazard(
        "work goes on although what a device of the laboratory's own measures is outside its limits",
        "as the laboratory has it: pressure, humidity, flow of the coolant",
        "lost session",
        (),
        ("channel_limit", "channel_silent"),
        _NOTHING_HEATS,
        ("system/test_added_channel.test_a_limit_is_set_on_it",),
    ),
    Hazard(
        "work goes on until the battery is empty after the mains has failed",
        "a camera, stages and a computer that lose power in the middle of a capture",
        "lost session",
        ("ups.*",),
        ("mains_lost", "battery_low", "ups_silent"),
        _NOTHING_HEATS + "; the relay board opens with its supply",
        ("system/test_mains.test_the_run_ends_in_order_before_the_battery_does",),
    ),
    Hazard(
        "heat although a contact of the stand says no",
        "as the contact's maker says: door, water, cut-out",
        "damage",
        ("inputs.changed",),
        ("contact",),
        "a contact that must cut the power is wired to cut it",
        ("system/test_inputs.test_an_open_door_ends_the_run_where_it_is_to_trip",),
    ),
    Hazard(
        "a frame is recorded with a temperature that is not the camera's",
        "a model of drift that is wrong",
        "wrong data",
        (
            "camera.frozen_temperature", "camera.no_temperature", "camera.refused_temperature",
            "camera.temperature_offset_K", "imager.*",
        ),
        ("camera_temperature_bad", "sensor_jumped", "sensor_stuck", "sensor_implausible", "sensor_outside"),
        _NOTHING_HEATS,
        ("stand/test_channels.test_a_camera_that_is_wrong_for_40_s_is_suspect_for_40_s",),
    ),
    Hazard(
        "a frame is lost, damaged, or taken for another",
        "a plan that is not carried out",
        "wrong data",
        (
            "camera.acks_twice", "camera.burst", "camera.control_lost", "camera.deaf", "camera.doubled",
            "camera.leader_early_s", "camera.loss", "camera.no_leader", "camera.no_resend", "camera.no_stream_channel",
            "camera.no_ticks", "camera.no_trailer", "camera.pending", "camera.reordered", "camera.restart",
            "camera.silent", "camera.stalled", "camera.stamp_*", "camera.stretch_s", "camera.trigger_twice",
            "camera.truncated", "camera.unpaced",
        ),
        ("device_lost", "device_fault"),
        _NOTHING_HEATS,
        ("system/test_camera_lost.test_a_camera_that_froze_past_its_heartbeat_is_lost_and_comes_back",),
    ),
    Hazard(
        "STOP is not carried out",
        "whatever goes on goes on",
        "fire",
        (),
        ("operator",),
        "the emergency stop, which cuts the power whatever a computer does",
        ("stand/test_listening.test_a_flood_of_clients_makes_neither_the_control_loop_late_nor_shuts_out_a_stop",),
    ),
)  # fmt: skip


def document() -> str:
    """docs/reference/hazards.md."""
    return "\n".join(_lines()) + "\n"


def _lines() -> Iterator[str]:
    yield from (
        "# Hazards",
        "",
        "What must not happen on a stand, by what it is found, how long that takes until heat and cold are off, and",
        "what limits it when the computer is dead. Made by `python -m tests.system.hazards` from its table;",
        "the times are measured by `make nightly` on the simulated stand, which is polled each 5 s, with the faults",
        "that `stand simulate --faults` lists. Each rule of the guard and each of those faults has a row; a test sees",
        "to it.",
        "",
    )
    measured: dict[str, dict[str, list[float]]] = json.loads(MEASURED.read_text())
    for number, hazard in enumerate(HAZARDS, 1):
        yield from (f"## {number}. {hazard.action[0].upper()}{hazard.action[1:]}", "")
        yield f"- Effect: {hazard.effect}. Severity: {hazard.severity}."
        yield f"- Found by: {', '.join(f'`{rule}`' for rule in hazard.rules)}."
        if hazard.faults:
            yield f"- Faults: {', '.join(f'`{fault}`' for fault in hazard.faults)}."
        for trial in hazard.trials:
            found_s, off_s = (sorted(column) for column in zip(*measured[trial.name].values(), strict=True))
            middle = len(found_s) // 2
            yield (
                f"- `{trial.name}`: found after {found_s[middle]:.1f} s (at worst {found_s[-1]:.1f} s), "
                f"heat and cold off after {off_s[middle]:.1f} s (at worst {off_s[-1]:.1f} s)."
            )
        yield f"- When the computer is dead: {hazard.dead}."
        yield from (f"- Test: `{', '.join(hazard.tests)}`.", "")


if __name__ == "__main__":
    print(document(), end="")  # noqa: T201 - the document
