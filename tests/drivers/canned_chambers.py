"""The languages of climate chambers, on damaged replies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from drivers.devices.chambers import chamber_ascii2, chamber_cts, chamber_espec
from drivers.devices.chambers.chamber_settings import Ascii2Settings, CtsSettings, EspecSettings
from drivers.wires.line_client import LineClient
from foundation.errors import GarbledReply, Refused, Unreachable
from tests.drivers.canned_line import Feed, Line, Parser

_ASCII2 = (
    b"0050.0 0024.6 0080.0 0066.7 0090.0 0090.0 0000.0 0023.8 0000.0 0022.2 0000.0 0025.5 0000.0 0024.4 "
    b"01100000000000000000000000000000\r",
    b"-040.0 -039.9 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 "
    b"01000000000000000000000000\r\n",
)
_ESPEC = (b"26.4,0.0,140.0,-50.0\r\n", b"-12.3,-20.0,140.0,-50.0\r\n", b"NA:CONT NOT READY-1\r\n")
_CTS = ("A0 024.5 025.0", "A0 -40.0 -39.8")

Asked = Callable[[int, bytes], Any]  # what a language makes of the bytes that have come to a request


def _language(frames: Sequence[bytes], answer: Asked, truth: Asked, refusals: frozenset[int] = frozenset()) -> Parser:
    """`truth`: what a reply may be taken for, read from its bytes in another way."""

    def make() -> Feed:
        line = Line()

        def feed(number: int, wire: bytes) -> bool:
            line.begin(wire)
            client = LineClient("chamber", lambda: line, timeout_s=1.0, gap_s=0.0, is_kept=True)
            with suppress(GarbledReply, Unreachable, Refused):
                found = client.send(b"?", lambda heard: answer(number, heard))
                half = wire[: len(wire) // 2]
                assert found in [truth(number, heard) for heard in (half, wire)], found
                return True
            return False

        return feed

    return Parser(frames, make, refusals)


def ascii2() -> Parser:
    settings = Ascii2Settings(protocol="ascii2", address="tcp:127.0.0.1:2049", limits_at_panel_degC=(-40.0, 60.0))
    language: Any = chamber_ascii2.Language("chamber", settings)

    def answer(number: int, heard: bytes) -> Any:
        language._shape = _shape(_ASCII2[number])  # of the reply before
        return language._answer(heard)

    def truth(number: int, heard: bytes) -> Any:
        if _shape(heard) != _shape(_ASCII2[number]) or heard.strip(b"-.0123456789 \r\n"):
            return None
        *fields, digits = heard.split()
        plain = all(len(field) == 6 and field[-2:-1] == b"." and field[1:4].isdigit() for field in fields)
        return ([float(field) for field in fields], digits.decode()) if plain and not digits.strip(b"01") else None

    return _language(_ASCII2, answer, truth)


def _shape(reply: bytes) -> tuple[int, int]:
    words = reply.split() or [b""]
    return len(words) - 1, len(words[-1])


def espec() -> Parser:
    language: Any = chamber_espec.Language("chamber", EspecSettings(protocol="espec", address="serial:/dev/x"))

    def truth(number: int, heard: bytes) -> Any:
        fields = heard.strip(b"\r\n").split(b",")
        sound = len(fields) == 4 and heard.endswith(b"\n") and not heard.strip(b"-.,0123456789 \r\n")
        return [float(field) for field in fields] if sound else None

    return _language(_ESPEC, lambda number, heard: language._parsed(heard, 4), truth, frozenset({2}))


def cts(kind: str) -> Parser:
    address = "serial:/dev/x" if kind == "serial" else "tcp:127.0.0.1:1080"
    settings = CtsSettings(protocol="cts", address=address, limits_at_panel_degC=(-40.0, 60.0))
    language: Any = chamber_cts.Language("chamber", settings)
    _, answer = language._asked("A0", 14, language._temperatures)

    def truth(number: int, heard: bytes) -> Any:
        text = heard
        if kind == "serial":
            check = 0
            for byte in heard[1:-2]:
                check ^= byte
            if heard[:2] != b"\x02\x81" or heard[-2:] != bytes([check | 0x80, 3]):
                return None
            text = bytes(byte & 0x7F for byte in heard[2:-2])
        name, *fields = text.split(b" ")
        return tuple(float(field) for field in fields) if (name, len(text)) == (b"A0", 14) else None

    frames = [chamber_cts.framed(1, text) if kind == "serial" else text.encode() for text in _CTS]
    return _language(frames, lambda number, heard: answer(heard), truth)
