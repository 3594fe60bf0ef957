"""The languages of climate chambers and of instruments that answer in text, on damaged replies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from math import isnan
from typing import Any, Literal

from tests.drivers.canned_line import Feed, Line, Parser
from thermostand.drivers.devices.chambers import (
    chamber_ascii2,
    chamber_cts,
    chamber_espec,
    chamber_julabo,
    chamber_simserv,
)
from thermostand.drivers.devices.chambers.chamber_ascii2 import Ascii2Settings
from thermostand.drivers.devices.chambers.chamber_cts import CtsSettings
from thermostand.drivers.devices.chambers.chamber_espec import EspecSettings
from thermostand.drivers.devices.probes import Probe, ProbeSettings
from thermostand.drivers.wires.line_client import LineClient
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import GarbledReply, Refused, Unreachable

_ASCII2 = (
    b"0050.0 0024.6 0080.0 0066.7 0090.0 0090.0 0000.0 0023.8 0000.0 0022.2 0000.0 0025.5 0000.0 0024.4 "
    b"01100000000000000000000000000000\r",
    b"-040.0 -039.9 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 0000.0 "
    b"01000000000000000000000000\r\n",
)
_ESPEC = (b"26.4,0.0,140.0,-50.0\r\n", b"-12.3,-20.0,140.0,-50.0\r\n", b"NA:CONT NOT READY-1\r\n")
_ESPEC_MONITOR = (b"24.1,50,CONSTANT,0\r\n", b"-10.4,,STANDBY,12\r\n")
_CTS = ("A0 024.5 025.0", "A0 -40.0 -39.8")
_CTS_STATE = ("S101000000", "S110?00005")
_SIMSERV = (b"1\xb624.98\r\n", b"1\xb6-5\r\n", b"1\r\n", b"1\xb6a text of an alarm\r\n", b"-8\r\n")
_JULABO = (b"24.60\r\n", b"-5.5\n", b"03 REMOTE START\r\n", b"-01 LOW LEVEL ALARM\r\n")
_TEXTS: dict[Literal["hart", "vaisala"], tuple[bytes, ...]] = {
    "hart": (b"t:   25.587 C\r\n", b"T\r\nt:  -12.003 C\r\n", b"t: ****** C\r\n"),
    "vaisala": (
        b"RH=  38.3 %RH T=  22.2 'C\r\n",
        b"SEND\r\nRH= 100.0 %RH T= -22.2 'C\r\n",
        b"RH= **** %RH T=  1.0 'C\r\n",
    ),
}

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
                # Flow control behind the end of a reply is no part of it.
                assert found in [truth(number, heard.rstrip(b"\x11\x13")) for heard in (half, wire)], found
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

    return _language(_ESPEC, lambda number, heard: language._limited(heard), truth, frozenset({2}))


def espec_monitor() -> Parser:
    language: Any = chamber_espec.Language("chamber", EspecSettings(protocol="espec", address="serial:/dev/x"))

    def truth(number: int, heard: bytes) -> Any:
        fields = [field.strip(b" ") for field in heard.strip(b"\r\n").split(b",")]
        sound = len(fields) >= 4 and heard.endswith(b"\n") and b"\n" not in heard.strip(b"\r\n")
        return (float(fields[0]), fields[1].decode(), fields[2].decode(), int(fields[-1])) if sound else None

    return _language(_ESPEC_MONITOR, lambda number, heard: language._monitor(heard), truth)


def simserv() -> Parser:
    def truth(number: int, heard: bytes) -> Any:
        if not heard.endswith(b"\r\n"):
            return None
        code, *values = heard[: len(heard) - 2].split(b"\xb6")
        return code.decode("latin-1"), [value.decode("latin-1") for value in values]

    def answer(number: int, heard: bytes) -> Any:
        found = chamber_simserv.parse_reply(heard)
        assert found is None or found[0] == "1" or (found[0][0] == "-" and not found[1])
        return found

    return _language(_SIMSERV, answer, truth)


def julabo() -> Parser:
    def truth(number: int, heard: bytes) -> Any:
        line = heard.strip(b"\r\n")
        if not heard.endswith(b"\n") or b"\n" in line:
            return None
        if number > 1:
            return line[: line.index(b" ")].decode(), line[line.index(b" ") + 1 :].decode()
        return float(line)

    return _language(
        _JULABO,
        lambda number, heard: (chamber_julabo.parse_status if number > 1 else chamber_julabo.parse_temperature)(heard),
        truth,
    )


def texts(kind: Literal["hart", "vaisala"]) -> Parser:
    """Of an instrument; a number that is not measured is NaN, and shown as None here."""
    probe: Any = Probe("probe", ProbeSettings(protocol=kind, address="serial:/dev/x"), WallClock())

    def plain(values: dict[str, float]) -> dict[str, float | None]:
        return {channel: None if isnan(value) else value for channel, value in values.items()}

    def answer(number: int, heard: bytes) -> Any:
        parsed = probe._parse_reply(heard)
        found = None if parsed is None else {channel.name: value for channel, value in parsed.items()}
        return None if found is None else plain(found)

    def between(line: str, word: str, unit: str) -> float | str | None:
        """The first number between them, None for one that was not measured; why there is none. The word is not the end
        of another one, and `t:` begins the line."""
        at = line.find(word)
        while at >= 0:
            text, found, _ = line[at + len(word) :].partition(unit)
            number = text.strip()
            whole, point, rest = number.removeprefix("-").partition(".")
            before = line[max(0, at - 1) : at]
            is_word = at == 0 if kind == "hart" else not (before.isalnum() or before == "_")
            if found and is_word and number and not number.strip("*"):
                return None
            if found and is_word and whole.isdecimal() and (rest.isdecimal() if point else True):
                return float(number)
            at = line.find(word, at + 1)
        return f"no {word}"

    words = (
        {"temperature": ("t:", "C")} if kind == "hart" else {"temperature": ("T=", "'C"), "humidity": ("RH=", "%RH")}
    )

    def truth(number: int, heard: bytes) -> Any:
        """Of the first line that has all."""
        for line in heard.decode("latin-1").split("\n")[:-1]:
            if kind == "vaisala" or line.startswith("t:"):
                found = {channel: between(line, *around) for channel, around in words.items()}
                if not any(isinstance(value, str) for value in found.values()):
                    return found
        return None

    return _language(_TEXTS[kind], answer, truth)


def cts(kind: str) -> Parser:
    address = "serial:/dev/x" if kind == "serial" else "tcp:127.0.0.1:1080"
    settings = CtsSettings(protocol="cts", address=address, limits_at_panel_degC=(-40.0, 60.0))
    language: Any = chamber_cts.Language("chamber", settings)
    _, answer = language._asked("A0", 14, language._temperatures)

    def truth(number: int, heard: bytes) -> Any:
        text = _unframed(heard) if kind == "serial" else heard
        if text is None:
            return None
        name, *fields = text.split(b" ")
        return tuple(float(field) for field in fields) if (name, len(text)) == (b"A0", 14) else None

    frames = [chamber_cts.wrap_frame(1, text) if kind == "serial" else text.encode() for text in _CTS]
    return _language(frames, lambda number, heard: answer(heard), truth)


def _unframed(heard: bytes) -> bytes | None:
    """The text of a frame of unit 1, None when it is none."""
    check = 0
    for byte in heard[1:-2]:
        check ^= byte
    if heard[:2] != b"\x02\x81" or heard[-2:] != bytes([check | 0x80, 3]):
        return None
    return bytes(byte & 0x7F for byte in heard[2:-2])


def cts_state(kind: str) -> Parser:
    """Its flags, and the byte of its error."""
    address = "serial:/dev/x" if kind == "serial" else "tcp:127.0.0.1:1080"
    settings = CtsSettings(protocol="cts", address=address, limits_at_panel_degC=(-40.0, 60.0))
    language: Any = chamber_cts.Language("chamber", settings)
    _, answer = language._asked("S", 10, language._flags)

    def truth(number: int, heard: bytes) -> Any:
        text = _unframed(heard) if kind == "serial" else heard
        sound = text is not None and len(text) == 10 and text[:1] == b"S" and not text[1:9].strip(b"01?")
        return (text[1:9].decode(), text[9:].decode("latin-1")) if text is not None and sound else None

    frames = [chamber_cts.wrap_frame(1, text) if kind == "serial" else text.encode() for text in _CTS_STATE]
    return _language(frames, lambda number, heard: answer(heard), truth)
