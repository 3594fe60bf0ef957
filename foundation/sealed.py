"""Small JSON files that know whether they are as they were written: a sector that kept its old content, or holds what
belongs elsewhere, often is valid JSON, too.

The first line is `{"crc32": "1a2b3c4d",`, of the kind of file and all that follows: what was meant for another kind
does not fit. It stays JSON for those who only read.
"""

from __future__ import annotations

import zlib

_HEAD = b'{"crc32": "%08x",\n'


def seal(kind: str, text: str) -> bytes:
    """The file's content; `text` is a JSON object with a field at least."""
    body = text.strip().removeprefix("{").lstrip().encode() + b"\n"
    return _HEAD % _compute_crc(kind, body) + body


def unseal(kind: str, data: bytes) -> bytes:
    """The JSON object; ValueError when the file is not as `seal` made it."""
    head, _, body = data.partition(b"\n")
    if head + b"\n" != _HEAD % _compute_crc(kind, body):
        raise ValueError("it is damaged: its checksum is wrong")
    return b"{" + body


def _compute_crc(kind: str, body: bytes) -> int:
    return zlib.crc32(body, zlib.crc32(kind.encode()))
