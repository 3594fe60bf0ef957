import math
from contextlib import suppress

import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from hypothesis import given
from hypothesis import strategies as st

from tests.recording.device_declarations import KINDS, form
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Channel, Frame, Quality, Reading, bad_reading
from thermostand.recording.format import messages
from thermostand.recording.format.batches import RecordedDevice, make_batch_schema, parse_batch_schema

TIME_NS = 1_767_290_400_123_456_789


def frame(image, **changes):
    fields = {
        "channel": "camera.image",
        "time_ns": TIME_NS,
        "exposure_s": 0.1,
        "gain_dB": 1.5,
        "camera_degC": 41.25,
        "block_id": 2**40 + 7,
        "camera_ticks": 123_456_789_012,
        "dropped": 3,
        "step_id": "cycle-1/capture-20",
    }
    return Frame(image=image, **(fields | changes))


def round_trip(kind, batch):
    encoder = form(batch.device, kind)
    return encoder.decode(encoder.encode(batch), batch.time_ns).readings


def same(left, right):
    """Equal readings, where NaN equals NaN."""
    key = [(r.channel, repr(r.value), r.unit, r.time_ns, r.quality, r.reason) for r in left]
    return sorted(key) == sorted((r.channel, repr(r.value), r.unit, r.time_ns, r.quality, r.reason) for r in right)


def test_temperatures_have_the_fields_and_values_a_viewer_expects():
    readings = (Reading("pt.air", 23.98, "degC", TIME_NS), bad_reading("pt.artifact", "degC", TIME_NS, "sensor break"))
    encoder = form("pt", "thermometers")
    message = encoder.message.FromString(encoder.encode(Batch("pt", TIME_NS, readings)))
    assert message.DESCRIPTOR.full_name == "thermostand.pt"
    assert [field.name for field in message.DESCRIPTOR.fields][:5] == [
        "device",
        "remarks",
        "time_ns",
        "granite_inside_degC",
        "granite_inside_degC_quality",
    ]
    assert (message.device, message.air_degC, message.air_degC_quality) == ("pt", 23.98, 1)
    assert math.isnan(message.artifact_degC)
    assert message.artifact_degC_quality == 3
    assert message.remarks[0].reason == "sensor break"
    assert math.isnan(message.laboratory_degC), "what was not measured must not look like 0 degC"
    assert message.laboratory_degC_quality == messages.ABSENT


quality_and_value = st.one_of(
    st.tuples(st.sampled_from([Quality.GOOD, Quality.STALE]), st.floats(allow_nan=False)),
    st.just((Quality.BAD, math.nan)),
)


@st.composite
def batches(draw):
    """A kind and a batch of any part of its quantities, with strangers, reasons and times of their own."""
    kind = draw(st.sampled_from(KINDS))
    known = [(each.name, each.unit) for each in form("dev", kind).device.channels]
    names = draw(st.lists(st.sampled_from([*known, ("humidity", "%"), (known[0][0], "K")]), unique=True))
    readings = []
    for name, unit in names:
        quality, value = draw(quality_and_value)
        time_ns = TIME_NS - draw(st.sampled_from([0, 0, 1, 10**9]))
        reason = draw(st.sampled_from(["", "", "no answer within 0.3 s"]))
        readings.append(Reading(f"dev.{name}", value, unit, time_ns, quality, reason))
    return kind, Batch("dev", TIME_NS, tuple(readings))


@given(batches())
def test_no_batch_loses_anything(case):
    kind, batch = case
    assert same(round_trip(kind, batch), batch.readings)


names = st.text("abz_09", min_size=1, max_size=3)
units = st.sampled_from(["", "1", "%", "degC", "mm", "l/min", "m^3/h", "µm", "Ω", "percent"])


@given(st.lists(st.builds(Channel, names, units, st.just("")), unique=True, max_size=6))
def test_channels_of_any_name_and_unit_have_a_field_each_and_are_known_again(channels):
    known = make_batch_schema("dev", RecordedDevice("added", tuple(channels)))
    assert parse_batch_schema(known.metadata) is known
    assert len(set(known.fields)) == len(channels)
    readings = tuple(Reading(f"dev.{each.name}", 1.5 + at, each.unit, TIME_NS) for at, each in enumerate(channels))
    data = known.encode(Batch("dev", TIME_NS, readings))
    assert known.decode(data, TIME_NS).readings == readings
    assert not known.message.FromString(data).remarks


@pytest.mark.parametrize(
    "metadata",
    [
        {},
        {"device": "../dev", "kind": "", "channels": "[]"},
        {"device": "dev", "kind": "", "channels": "{}"},
        {"device": "dev", "kind": "", "channels": '[["a"]]'},
        {"device": "dev", "kind": "", "channels": '[["a","m",""],["a","m",""]]'},
    ],
)
def test_a_topic_that_does_not_say_what_it_holds_is_refused(metadata):
    with pytest.raises(ValueError, match=r"channel|device|list"):
        parse_batch_schema(metadata)


def test_nan_is_the_same_bytes_whatever_arithmetic_made_it():
    encoder = form("pt", "thermometers")
    negative_nan = float(np.copysign(np.nan, -1.0))

    def encode(nan):
        return encoder.encode(Batch("pt", TIME_NS, (Reading("pt.air", nan, "degC", TIME_NS, Quality.BAD),)))

    assert encode(negative_nan) == encode(math.nan)


def test_one_instant_shared_by_a_batch_costs_no_remarks():
    def size(time_ns):
        readings = tuple(Reading(f"pt.{n}", 20.0, "degC", time_ns) for n in ("air", "artifact", "laboratory"))
        return len(form("pt", "thermometers").encode(Batch("pt", TIME_NS, readings)))

    assert size(TIME_NS - 5_000_000) - size(TIME_NS) == 9


@given(
    st.dictionaries(
        st.text(), st.one_of(st.integers(-(2**53), 2**53), st.floats(allow_nan=False), st.text(), st.none())
    ),
    st.sampled_from(StepState),
)
def test_a_step_survives_the_round_trip(parameters, state):
    mark = StepMark(TIME_NS, "cycle-1/soak-30", 17, "soak", state, parameters)
    assert messages.decode_step(messages.encode_step(mark), TIME_NS) == mark


@given(st.text(), st.sampled_from(["info", "warning", "error"]))
def test_an_event_survives_the_round_trip(text, level):
    event = Event(TIME_NS, level, "device_lost", text)
    assert messages.decode_event(messages.encode_event(event), TIME_NS) == event


def test_an_event_is_a_line_in_the_viewers_log():
    log = Log.FromString(messages.encode_log(Event(TIME_NS, "warning", "device_lost", "flap: no answer")))
    assert (log.level, log.name, log.message) == (Log.WARNING, "device_lost", "flap: no answer")
    assert log.timestamp.ToNanoseconds() == TIME_NS


def test_the_table_pose_is_metres_and_a_turn_about_z():
    pose = PoseInFrame.FromString(messages.encode_table_pose(TIME_NS, 250.0, 90.0)).pose
    assert pose.position.x == 0.25
    assert (pose.orientation.z, pose.orientation.w) == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))


@given(st.binary(max_size=60))
def test_random_bytes_are_a_message_or_a_session_error(data):
    decoders = [
        lambda: form("pt", "thermometers").decode(data, TIME_NS),
        lambda: messages.decode_step(data, TIME_NS),
        lambda: messages.decode_event(data, TIME_NS),
        lambda: messages.decode_frame_meta(data),
    ]
    for decode in decoders:
        with suppress(SessionError):
            decode()
