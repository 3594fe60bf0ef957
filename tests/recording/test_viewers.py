"""A session opens elsewhere: rerun's own loader reads it, and its schemas are those that Foxglove's viewers know.

rerun runs offline: without a display, and with a home of its own that says CI, so that it collects no usage data.
"""

import asyncio
import importlib.metadata
import re
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader

from tests.recording.full_session import ATTACHMENTS, INFO, make_half_second, record
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Reading
from thermostand.recording.format import messages
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.reading.session import Session

FOXGLOVE = {message.DESCRIPTOR.full_name: message for message in (CompressedImage, RawImage, PoseInFrame, Log)}


def everything(time_ns, index, *details):
    """Something on every topic."""
    yield from make_half_second(time_ns, index, *details)
    yield Batch("camera", time_ns, (Reading("camera.temperature", 40.0, "degC", time_ns),))


@pytest.fixture(scope="module", params=["zstd", "raw"])
def session(request, tmp_path_factory):
    """Six seconds in one segment per series, with every kind of item."""
    directory = tmp_path_factory.mktemp(request.param)
    asyncio.run(record(directory, items=everything, encoding=request.param, segment_s=600.0))
    return Session.open(directory)


def contents(path):
    """(topic -> messages, topic -> schema, schemas) as mcap's own reader sees the segment."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    counts = summary.statistics.channel_message_counts
    return (
        {channel.topic: counts.get(number, 0) for number, channel in summary.channels.items()},
        {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()},
        list(summary.schemas.values()),
    )


@pytest.fixture
def rerun(tmp_path):
    """Runs the program that rerun-sdk brings along; its standard output, or the test fails."""
    files = importlib.metadata.files("rerun-sdk") or []
    program = next(Path(file.locate()) for file in files if file.match("rerun_cli/rerun"))
    home = tmp_path / "home"
    home.mkdir()
    environment = {"HOME": str(home), "XDG_CONFIG_HOME": str(home), "CI": "true", "NO_COLOR": "1"}

    def run(*arguments):
        done = subprocess.run([program, *arguments], env=environment, capture_output=True, timeout=30, check=False)
        assert done.returncode == 0, done.stderr.decode()
        return done.stdout.decode()

    yield run
    assert not list(home.iterdir()), "usage data must not be collected"


@pytest.fixture
def load(rerun, tmp_path):
    """A segment through rerun's loader: entity -> rows of its messages, and entity -> components."""

    def convert(path):
        recording = tmp_path / "recording.rrd"
        rerun("mcap", "convert", str(path), "-o", str(recording), "--application-id", "thermostand")
        rows: Counter[str] = Counter()
        components: dict[str, set[str]] = {}
        line = r"^Chunk\(\w+\) with (\d+) rows .* - (/\S+) - data columns: \[(.*)\]$"
        for count, entity, columns in re.findall(line, rerun("rrd", "print", str(recording)), re.MULTILINE):
            components.setdefault(entity, set()).update(columns.split())
            if "McapChannel:id" not in columns:
                rows[entity] += int(count)
        return rows, components

    return convert


def test_rerun_finds_every_channel_and_message_and_nothing_to_complain_of(session, rerun):
    for path in session.segments:
        counts, schemas, _ = contents(path)
        info, check = rerun("mcap", "info", str(path)), rerun("mcap", "check", "--full", str(path))
        assert "embedded" in info, "the index is found"
        for topic, count in counts.items():
            assert count
            assert re.search(rf"{topic} +{count} .*{re.escape(schemas[topic])} +protobuf$", info, re.MULTILINE), info
            assert re.search(rf"^ok .* {topic} +—$", check, re.MULTILINE), check


def test_rerun_loads_every_message_as_what_it_is(session, load):
    telemetry, frames = session.segments
    rows, components = load(telemetry)
    counts, schemas, _ = contents(telemetry)
    for topic, count in counts.items():
        assert rows[topic] == count, topic
        if schemas[topic].startswith("thermostand."):
            assert f"{schemas[topic]}:message" in components[topic]
    assert {"InstancePoses3D:translations", "InstancePoses3D:quaternions"} <= components[messages.TABLE_POSE]
    assert {"TextLog:text", "TextLog:level"} <= components[messages.LOG]
    assert {"session", "segment"} <= components["/__mcap_metadata"]
    rows, components = load(frames)
    assert rows["/camera/image"] == rows["/camera/meta"] == session.frame_count
    assert {"Image:buffer", "Image:format"} <= components["/camera/image"]
    assert "thermostand.FrameMeta:message" in components["/camera/meta"]


def test_every_schema_stands_alone_and_those_of_foxglove_are_theirs(session):
    for path in session.segments:
        for schema in contents(path)[2]:
            assert schema.encoding == "protobuf"
            pool = DescriptorPool()
            for file in FileDescriptorSet.FromString(schema.data).file:
                pool.Add(file)  # in their order: each needs only those before
            found = pool.FindMessageTypeByName(schema.name)
            GetMessageClass(found)
            if schema.name.startswith("foxglove."):
                assert fields(found) == fields(FOXGLOVE[schema.name].DESCRIPTOR)


def fields(descriptor):
    """Name, number, type, whether repeated, and the same of its messages' fields, nested."""
    return [
        (
            field.name,
            field.number,
            field.type,
            field.is_repeated,
            field.enum_type and [(value.name, value.number) for value in field.enum_type.values],
            field.message_type and (field.message_type.full_name, fields(field.message_type)),
        )
        for field in descriptor.fields
    ]


def test_mcap_tools_see_the_session_and_its_files(session):
    for path in session.segments:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            attached = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
            table = attached.pop("frames", None)
            assert (table is not None) == (path.parent.name == FRAMES)
            assert {name: data.decode() for name, data in attached.items()} == ATTACHMENTS
            metadata = {record.name: record.metadata for record in reader.iter_metadata()}
            read = Counter(channel.topic for _, channel, _ in reader.iter_messages())
        assert metadata["session"] == INFO.metadata()
        assert metadata["segment"]["series"] == {TELEMETRY: TELEMETRY, FRAMES: FRAMES}[path.parent.name]
        assert read == Counter(contents(path)[0])
