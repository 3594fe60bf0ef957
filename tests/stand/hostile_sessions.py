"""Sessions that are damaged, incomplete, or made by somebody who means harm: each a change of a sound one.

A row has the word for its files that `stand session verify` says (NONE where it says that there is no session), and
whether it is left to the nightly run.
"""

import json
import os
import random
import shutil
import socket
import struct
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from thermostand.foundation.errors import SessionError
from thermostand.recording.format import messages
from thermostand.recording.format.journal_lines import format_lines, parse_lines
from thermostand.recording.format.layout import FRAME_TABLE, FRAMES, TELEMETRY
from thermostand.recording.format.manifest import MANIFEST_NAME
from thermostand.recording.format.mcap_bytes import CHUNK, LENGTH, RECORD
from thermostand.recording.format.mcap_contents import LIBRARY
from thermostand.recording.writing.manifest_file import write_manifest

SOUND, INCOMPLETE, DAMAGED, UNKNOWN, NONE = "sound", "incomplete", "damaged", "unknown", ""
GB = 1 << 30
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Row:
    """One session."""

    make: Callable[[Path], object]
    files: str
    nightly: bool = False


def telemetry(session: Path, number: int) -> Path:
    return session / TELEMETRY / f"{number:04d}.mcap"


def frames(session: Path, number: int) -> Path:
    return session / FRAMES / f"{number:04d}.mcap"


def change(path: Path, change: Callable[[bytearray], object]) -> None:
    data = bytearray(path.read_bytes())
    change(data)
    path.write_bytes(data)


def cut(path: Path, part: float = 0.5) -> None:
    os.truncate(path, int(path.stat().st_size * part))


def flip(path: Path, part: float) -> None:
    def one(data: bytearray) -> None:
        data[int(len(data) * part)] ^= 16

    change(path, one)


def hole(path: Path, part: float, size: int = 4096) -> None:
    def zeros(data: bytearray) -> None:
        begin = int(len(data) * part)
        end = min(len(data), begin + size)
        data[begin:end] = bytes(end - begin)

    change(path, zeros)


def sparse(path: Path, size_bytes: int) -> None:
    path.touch()
    os.truncate(path, size_bytes)


def listening(path: Path) -> None:
    """A socket of that name; its path would be too long from elsewhere."""
    before = Path.cwd()
    os.chdir(path.parent)
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    finally:
        os.chdir(before)


def journal(session: Path, *lines: bytes) -> None:
    """Lines with the right CRC behind those of the run."""
    data = (session / "journal.jsonl").read_bytes()
    (session / "journal.jsonl").write_bytes(data + format_lines(lines, parse_lines(data).mark, len(data)))


def remove_end(session: Path) -> None:
    for path in (telemetry(session, 4), telemetry(session, 5), frames(session, 4)):
        path.unlink()


def double(session: Path) -> None:
    shutil.copy(frames(session, 1), frames(session, 5))


def swap(session: Path) -> None:
    one, other = frames(session, 1), frames(session, 2)
    one.rename(session / "kept")
    other.rename(one)
    (session / "kept").rename(other)


def exchange_series(session: Path) -> None:
    """Each series under the other's name."""
    (session / FRAMES).rename(session / "kept")
    (session / TELEMETRY).rename(session / FRAMES)
    (session / "kept").rename(session / TELEMETRY)


def false_heads(session: Path, size_bytes: int) -> None:
    """An unfinished segment of heads of chunks that each claim all the rest."""
    data = bytearray(size_bytes)
    for place in range(0, size_bytes - 100, 320):
        length = size_bytes - place - RECORD.size
        data_bytes = length - CHUNK.size - LENGTH.size
        head = RECORD.pack(6, length) + CHUNK.pack(1, 2, data_bytes, 12345, 0) + LENGTH.pack(data_bytes)
        data[place : place + len(head)] = head
    (session / FRAMES / "0005.mcap.part").write_bytes(data)


def rewrite(
    path: Path,
    attachments: dict[str, bytes] | None = None,
    behind=(),
    instead=None,
    relist: bool = True,
    without: str = "",
    **session: str,
) -> None:
    """The segment with other attachments, metadata, messages behind its own ((topic, data), ...), or images instead.
    relist: whoever does that makes a manifest of it as well. without: a topic of which no message stays."""
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        known = list(reader.iter_attachments())
        metadata = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
        found = [(channel.topic, message) for _, channel, message in reader.iter_messages(log_time_order=False)]
    table = [one.data for one in known if one.name == FRAME_TABLE]
    known = [one for one in known if one.name != FRAME_TABLE]
    is_frames = path.parent.name == FRAMES
    new = path.with_suffix(".new")
    with new.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(library=LIBRARY)
        for one in known:
            data = one.data if attachments is None else attachments.get(one.name, one.data)
            writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, data)
        metadata["session"] |= session
        if session:
            metadata["segment"].pop("session_crc32", None)
        for name, entries in metadata.items():
            writer.add_metadata(name, entries)
        schemas = {n: writer.register_schema(s.name, s.encoding, s.data) for n, s in sorted(summary.schemas.items())}
        channels = {
            c.topic: writer.register_channel(c.topic, c.message_encoding, schemas[c.schema_id], c.metadata)
            for _, c in sorted(summary.channels.items())
        }
        for topic, message in found:
            if topic == without:
                continue
            data = instead(message.data) if instead and topic.endswith("/image") else message.data
            writer.add_message(channels[topic], message.log_time, data, message.publish_time, message.sequence)
            if is_frames and topic.endswith("/image"):
                writer.flush()
        last = found[-1][1].log_time
        for topic, data in behind:
            writer.add_message(channels[topic], last, data, last, 0)
        for data in table:
            writer.add_attachment(0, 0, FRAME_TABLE, "application/x-protobuf", data)
        writer.finish()
    new.replace(path)
    if relist:
        relist_segments(path.parent.parent)


def relist_segments(session: Path) -> None:
    """With a manifest of what is there, where it has one and any of it can be read."""
    with suppress(SessionError):
        if (session / MANIFEST_NAME).exists():
            write_manifest(session)


def everywhere(session: Path, relist: bool = True, **changes) -> None:
    for series in (TELEMETRY, FRAMES):
        for path in sorted((session / series).glob("*.mcap")):
            rewrite(path, relist=False, **changes)
    if relist:
        relist_segments(session)


def attach_configuration(text: bytes) -> Callable[[Path], None]:
    """A session with that attached as its configuration, recipe and target."""
    return lambda session: everywhere(
        session, attachments=dict.fromkeys(("config.yaml", "recipe.yaml", "target.yaml"), text)
    )


def event(kind: str, text: str, data_json: str) -> tuple[str, bytes]:
    made = messages.CLASSES[messages.EVENT](level="info", kind=kind, text=text, data_json=data_json)
    return messages.EVENT, made.SerializeToString()


def add_events(*events: tuple[str, bytes]) -> Callable[[Path], None]:
    """A session with events behind the others of its first segment."""
    return lambda session: rewrite(telemetry(session, 0), behind=events)


def step(parameters_json: str, **fields: object) -> tuple[str, bytes]:
    known = {"step_id": "x", "index": 3, "kind": "soak", "state": "started"} | fields
    made = messages.CLASSES[messages.STEP](parameters_json=parameters_json, **known)
    return messages.STEP, made.SerializeToString()


def png(width: int, height: int, pixels: bytes, colour: int = 0, depth: int = 8) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return PNG_SIGNATURE + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def black(width: int, height: int) -> bytes:
    packer = zlib.compressobj(9)
    row = bytes(width + 1)
    return png(width, height, b"".join(packer.compress(row) for _ in range(height)) + packer.flush())


def change_images(change: Callable[[RawImage], object]) -> Callable[[Path], None]:
    """A session whose first images are changed so."""

    def make(session: Path) -> None:
        def image(message: bytes) -> bytes:
            read = RawImage.FromString(message)
            change(read)
            return read.SerializeToString()

        rewrite(frames(session, 0), instead=image)

    return make


def sized(image: RawImage, width: int, height: int, data: bytes) -> None:
    image.width, image.height, image.step, image.data = width, height, width, data


def merges(depth: int) -> bytes:
    """Each mapping merges ten times the one before it."""
    lines = ["a0: &a0 {x: 1}"]
    lines += [f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 10)}]}}" for n in range(1, depth)]
    return "\n".join(lines).encode()


def aliases() -> bytes:
    lines = ["a: &a [1,1,1,1,1,1,1,1,1,1]"]
    lines += [f"{n}: &{n} [{','.join([f'*{p}'] * 10)}]" for p, n in zip("abcdefgh", "bcdefghi", strict=True)]
    return "\n".join(lines).encode()


def rename_copy(name: str) -> Callable[[Path], None]:
    """A session beside it of that name, too: a copy whose files are links."""

    def make(session: Path) -> None:
        os.symlink(session, session.parent / name)

    return make


def loop_links(session: Path) -> None:
    shutil.rmtree(session / FRAMES)
    (session / FRAMES).symlink_to(session / FRAMES)


FORMULA = "=cmd|' /C calc'!A0\x1b[2J\x07"
DEEP = "[" * 100_000

ROWS: dict[str, Row] = {
    "nothing wrong": Row(lambda s: None, SOUND),
    # damaged files
    "telemetry cut off": Row(lambda s: cut(telemetry(s, 2)), DAMAGED),
    "the last frames cut off": Row(lambda s: cut(frames(s, 4)), DAMAGED),
    "a bit of the telemetry flipped": Row(lambda s: flip(telemetry(s, 1), 0.6), DAMAGED),
    "a bit of a frame flipped": Row(lambda s: flip(frames(s, 1), 0.6), DAMAGED),
    "a bit of an index flipped": Row(lambda s: flip(frames(s, 1), 0.95), DAMAGED),
    "a bit of the first byte flipped": Row(lambda s: flip(telemetry(s, 0), 0.0), DAMAGED),
    "a lost block of the disk": Row(lambda s: hole(frames(s, 2), 0.4), DAMAGED),
    "telemetry without a byte": Row(lambda s: os.truncate(telemetry(s, 1), 0), DAMAGED),
    "frames without a byte": Row(lambda s: os.truncate(frames(s, 1), 0), DAMAGED),
    "an unfinished segment without a byte": Row(lambda s: (s / FRAMES / "0005.mcap.part").touch(), INCOMPLETE),
    "nothing but zeros": Row(lambda s: (s / FRAMES / "0005.mcap.part").write_bytes(bytes(1 << 22)), INCOMPLETE),
    "random bytes": Row(lambda s: telemetry(s, 1).write_bytes(random.Random(1).randbytes(100_000)), DAMAGED),
    "a text for a segment": Row(lambda s: telemetry(s, 1).write_text("a cloudy day\n"), DAMAGED),
    "a picture for a segment": Row(lambda s: frames(s, 1).write_bytes(black(40, 30)), DAMAGED),
    # segments that are not there, or not where they belong
    "telemetry missing in the middle": Row(lambda s: telemetry(s, 2).unlink(), INCOMPLETE),
    "frames missing in the middle": Row(lambda s: frames(s, 2).unlink(), INCOMPLETE),
    "the end missing": Row(remove_end, INCOMPLETE),
    "no telemetry": Row(lambda s: shutil.rmtree(s / TELEMETRY), INCOMPLETE),
    "no frames": Row(lambda s: shutil.rmtree(s / FRAMES), INCOMPLETE),
    "nothing at all": Row(lambda s: [shutil.rmtree(s / name) for name in (TELEMETRY, FRAMES)], NONE),
    "a segment twice": Row(double, DAMAGED),
    "two segments exchanged": Row(swap, DAMAGED),
    "the series exchanged": Row(exchange_series, DAMAGED),
    "a segment of another session": Row(lambda s: rewrite(frames(s, 2), session_id="cycle-2"), DAMAGED),
    "a later format": Row(lambda s: everywhere(s, format="999"), UNKNOWN),
    "a format that is no number": Row(lambda s: everywhere(s, format="two"), UNKNOWN),
    "a field that is not known": Row(lambda s: everywhere(s, format_version="999"), SOUND),
    "a segment far outside": Row(lambda s: shutil.copy(telemetry(s, 1), s / TELEMETRY / "99999999999.mcap"), DAMAGED),
    "an empty segment far outside": Row(lambda s: (s / TELEMETRY / "99999999999.mcap").touch(), DAMAGED),
    "a number of 200 digits": Row(lambda s: (s / FRAMES / f"{'9' * 200}.mcap").touch(), DAMAGED),
    # what is no file
    "a pipe for telemetry": Row(lambda s: os.mkfifo(telemetry(s, 6)), SOUND),
    "a pipe for an unfinished segment": Row(lambda s: os.mkfifo(s / FRAMES / "0005.mcap.part"), SOUND),
    "a pipe for a journal": Row(lambda s: ((s / "journal.jsonl").unlink(), os.mkfifo(s / "journal.jsonl")), INCOMPLETE),
    "a socket for a segment": Row(lambda s: listening(telemetry(s, 6)), SOUND),
    "a device for a segment": Row(lambda s: telemetry(s, 6).symlink_to("/dev/zero"), SOUND),
    "a link to itself for a segment": Row(lambda s: telemetry(s, 6).symlink_to("0006.mcap"), SOUND),
    "a folder for a segment": Row(lambda s: telemetry(s, 6).mkdir(), SOUND),
    "a folder that is a link to itself": Row(loop_links, INCOMPLETE),
    "a session by a link of an odd name": Row(rename_copy("=1\x1b[31m\n"), SOUND),
    # far too large
    "an unfinished segment of 20 GB of nothing": Row(
        lambda s: sparse(s / FRAMES / "0005.mcap.part", 20 * GB), INCOMPLETE
    ),
    "a segment of 20 GB of nothing": Row(lambda s: sparse(frames(s, 5), 20 * GB), DAMAGED),
    "false heads": Row(lambda s: false_heads(s, 1_000_000), INCOMPLETE),
    "8 MB of false heads": Row(lambda s: false_heads(s, 8_000_000), INCOMPLETE, nightly=True),
    # the journal
    "no journal": Row(lambda s: (s / "journal.jsonl").unlink(), INCOMPLETE),
    "an empty journal": Row(lambda s: os.truncate(s / "journal.jsonl", 0), SOUND),
    "a journal cut off": Row(lambda s: cut(s / "journal.jsonl", 0.99), SOUND),
    "a bit of the journal flipped": Row(lambda s: flip(s / "journal.jsonl", 0.5), DAMAGED),
    "a folder for a journal": Row(
        lambda s: ((s / "journal.jsonl").unlink(), (s / "journal.jsonl").mkdir()), INCOMPLETE
    ),
    "a deep journal": Row(lambda s: journal(s, DEEP.encode()), SOUND),
    "a journal of huge numbers": Row(lambda s: journal(s, b'{"entry": "Reset", "time_ns": %s}' % (b"9" * 5000)), SOUND),
    "a journal of no numbers": Row(lambda s: journal(s, b'{"entry": "Reset", "time_ns": NaN}'), SOUND),
    "a journal of wrong types": Row(lambda s: journal(s, b'{"entry": ["Step"], "time_ns": {}}', b"[]", b"7"), SOUND),
    "a journal that is not UTF-8": Row(lambda s: journal(s, b'{"entry": "\xff\xfe"}'), SOUND),
    "a journal of 9 MB": Row(
        lambda s: journal(s, *[b'{"entry": "Reset", "time_ns": 1}'] * 200_000), SOUND, nightly=True
    ),
    # what is attached and stated
    "a configuration of aliases": Row(attach_configuration(aliases()), SOUND),
    "a configuration of merge keys": Row(attach_configuration(merges(12)), SOUND),
    "a configuration of 60,000 keys": Row(
        attach_configuration("\n".join(f"k{n}: 1" for n in range(60_000)).encode()), SOUND, nightly=True
    ),
    "a deep configuration": Row(attach_configuration(DEEP.encode()), SOUND),
    "a configuration that is not UTF-8": Row(attach_configuration(b"name: \xff\xfe\n"), DAMAGED),
    "a configuration that is code": Row(
        attach_configuration(b"name: !!python/object/apply:os.system ['true']\n"), SOUND
    ),
    "a deep event": Row(add_events(event("note", "deep", DEEP)), DAMAGED),
    "an event of huge numbers": Row(add_events(event("note", "huge", '{"x": %s}' % ("9" * 5000))), DAMAGED),
    "an event of no numbers": Row(
        add_events(event("clock_step", "none", '{"offset_ns": NaN, "time_ns": Infinity}')), SOUND
    ),
    "events of wrong types": Row(
        add_events(
            *(
                event(kind, "x", json.dumps({"status": [], "steps": {}, "blocks": "x", "offset_ns": "x"}))
                for kind in ("run.start", "run.end", "frames_dropped", "clock_step", "gap", "interrupted")
            )
        ),
        SOUND,
    ),
    "an event for a spreadsheet and a terminal": Row(add_events(event("note", FORMULA, "")), SOUND),
    "a step of wrong types": Row(add_events(step('{"duration_s": "x", "frames": -1}', index=2_000_000_000)), SOUND),
    "a step that is no JSON": Row(add_events(step("{")), DAMAGED),
    # images
    "a picture of 256 megapixels": Row(change_images(lambda read: sized(read, 16_000, 16_000, b"x")), SOUND),
    "a picture of 4 million megapixels": Row(
        change_images(lambda read: sized(read, 2_000_000, 2_000_000, b"x")), SOUND
    ),
    "a picture in colour": Row(change_images(lambda read: setattr(read, "encoding", "rgb8")), SOUND),
    "a picture of another format": Row(change_images(lambda read: setattr(read, "encoding", "GIF89a\x1b[2J")), SOUND),
    "a picture cut off": Row(change_images(lambda read: setattr(read, "data", read.data[:-20])), SOUND),
    "a picture of 60 megapixels": Row(
        change_images(lambda read: sized(read, 10_000, 6_000, bytes(60_000_000))), SOUND, nightly=True
    ),
}
