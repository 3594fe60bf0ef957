import pytest

from thermostand.drivers.sim.gige.camera import Exposure, Schedule
from thermostand.drivers.sim.gige.camera_registers import Registers
from thermostand.drivers.sim.gige.genicam import make_features

MS = 1_000_000
SOFTWARE, LINE0 = 0, 1


@pytest.fixture
def registers() -> Registers:
    """2 frames a second, 100 ms of exposure."""
    registers = Registers(make_features(64, 48, "SN1"), "127.0.0.71", "SN1")
    registers.put("ExposureTime", 100_000.0)
    registers.put("AcquisitionFrameRate", 2.0)
    registers.put("AcquisitionFrameRateEnable", 1)
    return registers


def taken(schedule: Schedule, now_ns: int) -> Exposure | None:
    return schedule.due(now_ns)[0]


def test_nothing_is_exposed_before_the_start_and_after_the_stop(registers: Registers) -> None:
    schedule = Schedule(registers, real_time=True)
    assert taken(schedule, 10_000 * MS) is None
    schedule.start(0)
    assert registers.integer("TLParamsLocked") == 1
    schedule.stop()
    assert registers.integer("TLParamsLocked") == 0
    assert taken(schedule, 10_000 * MS) is None


def test_a_free_running_frame_is_due_when_its_exposure_has_ended(registers: Registers) -> None:
    schedule = Schedule(registers, real_time=True)
    schedule.start(1000 * MS)
    assert schedule.due(1099 * MS) == (None, 1100 * MS)
    assert taken(schedule, 1100 * MS) == Exposure(1, 0, 1000 * MS, 100 * MS, 0.0)
    assert schedule.due(1100 * MS) == (None, 1600 * MS)
    shot = taken(schedule, 1600 * MS)
    assert shot is not None
    assert (shot.index, shot.middle_ns) == (1, 1550 * MS)


def test_the_free_run_drops_late_frames_and_counts_them(registers: Registers) -> None:
    schedule = Schedule(registers, real_time=False)
    schedule.start(0)
    shot = taken(schedule, 5000 * MS)
    assert shot is not None
    assert (shot.index, shot.start_ns) == (9, 4500 * MS)
    assert taken(schedule, 5000 * MS) is None


def test_the_period_is_never_shorter_than_the_exposure(registers: Registers) -> None:
    registers.put("ExposureTime", 2_000_000.0)
    schedule = Schedule(registers, real_time=True)
    schedule.start(0)
    assert taken(schedule, 2000 * MS) == Exposure(1, 0, 0, 2000 * MS, 0.0)
    assert schedule.due(2000 * MS) == (None, 4000 * MS)


def test_a_change_of_rate_goes_on_from_where_it_is(registers: Registers) -> None:
    schedule = Schedule(registers, real_time=True)
    schedule.start(0)
    assert taken(schedule, 1100 * MS) == Exposure(1, 2, 1000 * MS, 100 * MS, 0.0)
    registers.put("AcquisitionFrameRate", 1.0)
    schedule.reschedule(1200 * MS)
    assert taken(schedule, 1300 * MS) == Exposure(1, 3, 1200 * MS, 100 * MS, 0.0)
    assert schedule.due(1300 * MS) == (None, 2300 * MS)


def test_a_trigger_exposes_from_now_and_is_due_at_its_end_in_real_time(registers: Registers) -> None:
    registers.put("TriggerMode", 1)
    registers.put("Gain", 6.0)
    schedule = Schedule(registers, real_time=True)
    schedule.start(0)
    assert taken(schedule, 900 * MS) is None
    schedule.trigger(1000 * MS)
    assert schedule.due(1000 * MS) == (None, 1100 * MS)
    assert taken(schedule, 1100 * MS) == Exposure(1, 0, 1000 * MS, 100 * MS, 6.0)
    assert taken(schedule, 1200 * MS) is None


def test_a_trigger_is_due_at_once_in_virtual_time(registers: Registers) -> None:
    registers.put("TriggerMode", 1)
    schedule = Schedule(registers, real_time=False)
    schedule.start(0)
    for index in range(2):
        schedule.trigger(1000 * MS)
        assert taken(schedule, 1000 * MS) == Exposure(1, index, 1000 * MS, 100 * MS, 0.0)


@pytest.mark.parametrize(("mode", "source"), [(0, SOFTWARE), (1, LINE0)])
def test_a_software_trigger_that_nobody_waits_for_does_nothing(registers: Registers, mode: int, source: int) -> None:
    registers.put("TriggerMode", mode)
    registers.put("TriggerSource", source)
    schedule = Schedule(registers, real_time=False)
    schedule.start(0)
    schedule.trigger(0)
    assert taken(schedule, 0) is None


def test_a_single_frame_ends_its_acquisition_and_may_still_be_sent(registers: Registers) -> None:
    registers.put("AcquisitionMode", 1)
    schedule = Schedule(registers, real_time=False)
    schedule.start(0)
    shot = taken(schedule, 2000 * MS)
    assert shot is not None
    assert not schedule.streaming
    assert schedule.is_current(shot)
    assert registers.integer("TLParamsLocked") == 0
    assert taken(schedule, 9000 * MS) is None


def test_an_exposure_of_a_stopped_acquisition_is_not_sent_in_the_next(registers: Registers) -> None:
    schedule = Schedule(registers, real_time=False)
    schedule.start(0)
    shot = taken(schedule, 100 * MS)
    assert shot is not None
    schedule.stop()
    schedule.start(200 * MS)
    assert not schedule.is_current(shot)
