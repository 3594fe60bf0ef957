"""A disk that logs every write and flush, so that each state it can have had when the power failed can be made again.

`python -m tests.system.logged_disk FOLDER IMAGE LOG` mounts a file system of two files on FOLDER, in the kernel's FUSE
protocol (linux/fuse.h, 7.31) and without a library. `disk` begins as IMAGE and is meant for a loop device; what is
written into `marks` stands in the log behind everything the disk had got by then. It ends when FOLDER is unmounted.
"""

import ctypes
import errno
import os
import struct
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import pytest

LIMIT_S = 60
WRITE, FLUSH, MARK = b"W", b"F", b"M"
ENTRY = struct.Struct("<cQI")  # kind, offset, length of the data behind it

GREATEST_WRITE_BYTES = 1 << 20
REQUEST = struct.Struct("<IIQQIIII")  # length, opcode, unique, node, uid, gid, pid, padding
REPLY = struct.Struct("<IiQ")  # length, -errno, unique
MAX_PAGES, BIG_WRITES, DIRECT_IO = 1 << 22, 1 << 5, 1
ROOT, DISK, MARKS = 1, 2, 3
NODES = {b"disk": DISK, b"marks": MARKS}


class Op(IntEnum):
    """Opcodes of FUSE that are answered here."""

    LOOKUP = 1
    FORGET = 2
    GETATTR = 3
    SETATTR = 4
    OPEN = 14
    READ = 15
    WRITE = 16
    STATFS = 17
    RELEASE = 18
    FSYNC = 20
    FLUSH = 25
    INIT = 26
    OPENDIR = 27
    RELEASEDIR = 29
    ACCESS = 34
    INTERRUPT = 36
    DESTROY = 38
    BATCH_FORGET = 42


SILENT = (Op.FORGET, Op.BATCH_FORGET, Op.INTERRUPT)
EMPTY = (Op.RELEASE, Op.FLUSH, Op.RELEASEDIR, Op.ACCESS, Op.DESTROY)


@dataclass(frozen=True)
class Entry:
    """A write of `data` at `offset`, a flush, or a mark."""

    kind: bytes
    offset: int
    data: bytes


def read_log(path):
    """The entries in the order in which the disk got them."""
    log, entries, begin = path.read_bytes(), [], 0
    while begin < len(log):
        kind, offset, length = ENTRY.unpack_from(log, begin)
        begin += ENTRY.size + length
        entries.append(Entry(kind, offset, log[begin - length : begin]))
    return entries


class LoggedDisk:
    """Answers the kernel, one request after the other."""

    def __init__(self, fuse, image, log):
        self.fuse = fuse
        self.content = bytearray(image.read_bytes())
        self.log = log.open("wb", buffering=0)

    def serve(self):
        while True:
            try:
                request = os.read(self.fuse, GREATEST_WRITE_BYTES + 4096)
            except OSError:  # unmounted
                return
            _, opcode, unique, node, *_ = REQUEST.unpack_from(request)
            if opcode in SILENT:
                continue
            data = self.answer(opcode, node, request[REQUEST.size :])
            error = -errno.ENOENT if opcode == Op.LOOKUP else -errno.ENOSYS
            data, error = (b"", error) if data is None else (data, 0)
            os.write(self.fuse, REPLY.pack(REPLY.size + len(data), error, unique) + data)

    def answer(self, opcode, node, body) -> bytes | None:
        """The data of the reply (the structures of linux/fuse.h), None when it is an error."""
        match opcode:
            case Op.INIT:
                flags, pages = BIG_WRITES | MAX_PAGES, GREATEST_WRITE_BYTES // 4096
                return struct.pack("<IIIIHHIIHHI28x", 7, 31, 0, flags, 16, 12, GREATEST_WRITE_BYTES, 1, pages, 0, 0)
            case Op.LOOKUP:
                child = NODES.get(body.rstrip(b"\0"))
                return struct.pack("<Q32x", child) + self.attributes(child) if child else None
            case Op.GETATTR | Op.SETATTR:
                return bytes(16) + self.attributes(node)
            case Op.OPEN | Op.OPENDIR:
                return struct.pack("<QII", 0, DIRECT_IO if node == MARKS else 0, 0)
            case Op.READ:
                offset, size = struct.unpack_from("<8xQI", body)
                return bytes(self.content[offset : offset + size])
            case Op.WRITE:
                return self.written(node, body)
            case Op.FSYNC:
                self.note(FLUSH)
                return b""
            case Op.STATFS:
                return struct.pack("<QQQQQIIII24x", 1 << 20, 0, 0, 3, 0, 4096, 255, 4096, 0)
        return b"" if opcode in EMPTY else None

    def written(self, node, body):
        offset, size = struct.unpack_from("<8xQI", body)
        data = body[40 : 40 + size]
        if node == DISK:
            self.content[offset : offset + size] = data
        self.note(WRITE if node == DISK else MARK, offset, data)
        return struct.pack("<II", size, 0)

    def note(self, kind, offset=0, data=b""):
        self.log.write(ENTRY.pack(kind, offset, len(data)) + data)

    def attributes(self, node):
        mode, size = (0o040755, 0) if node == ROOT else (0o100644, len(self.content) if node == DISK else 0)
        return struct.pack("<QQQ36xIIIIIII", node, size, size // 512, mode, 1, 0, 0, 0, 4096, 0)


def say(text):
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def main(folder, image, log):
    """Says `mounted`, or why it cannot."""
    try:
        fuse = os.open("/dev/fuse", os.O_RDWR)
    except OSError as error:
        say(f"there is no FUSE here: {error}")
        return
    libc = ctypes.CDLL(None, use_errno=True)
    options = f"fd={fuse},rootmode=40000,user_id=0,group_id=0".encode()
    if libc.mount(b"logged", os.fsencode(folder), b"fuse", 0, options):
        say(f"no FUSE file system can be mounted here: {os.strerror(ctypes.get_errno())}")
        return
    say("mounted")
    LoggedDisk(fuse, Path(image), Path(log)).serve()


@contextmanager
def logged_disk(folder, image, log):
    """The files `disk` and `marks` in `folder`; skips the test where that cannot be."""
    folder.mkdir()
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-m", "tests.system.logged_disk", folder, image, log]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as server:
        line = server.stdout.readline().strip()
        if line != "mounted":
            server.kill()
            pytest.skip(line or "the logging disk did not begin")
        try:
            yield folder
        finally:
            subprocess.run(["umount", "--lazy", folder], check=False)
            try:
                server.wait(LIMIT_S)
            finally:
                server.kill()


if __name__ == "__main__":
    main(*sys.argv[1:])
