"""SECoP clients that send garbage, flood, crowd or never read."""

import asyncio
import random
import time
from contextlib import suppress
from pathlib import Path

import pytest

from tests.stand.secop_service import SecopService, node
from tests.stand.secop_talk import LIMIT_S, talking
from tests.stand.test_interface_access import EVIL, PROXIED, TOKEN
from thermostand.stand.serving import secop
from thermostand.stand.serving.secop import LINE_LIMIT_BYTES


@pytest.mark.parametrize(
    "head",
    [
        f"POST / HTTP/1.1\r\nHost: evil.example\r\nOrigin: {EVIL}\r\n",
        "POST /do HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: null\r\nSec-Fetch-Site: cross-site\r\n",
        f"PUT / HTTP/1.0\r\nAuthorization: Bearer {TOKEN}\r\n" + "".join(f"{n}: {v}\r\n" for n, v in PROXIED.items()),
        "GET / HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n",
        "\x16\x03\x01\x02\x00\x01",
        "EHLO evil.example\r\n",
    ],
)
async def test_who_was_made_to_speak_here_orders_nothing(tmp_path: Path, head: str):
    """A page of another site can send this port what it likes, but not as its first line."""
    desk = SecopService()
    async with node(desk, tmp_path) as port, talking(port) as talk:
        talk.say(f"{head}\r\n*IDN?", "do run:stop", "change chamber:target 60", 'do run:_submit "overnight"')
        reported = await talk.end()
        assert reported.count(b"\n") <= 1
        async with talking(port) as other:
            assert (await other.asked("read chamber"))[0] == "reply"
    assert desk.orders == []


@pytest.mark.parametrize(
    "sent", [b"x" * (2 * LINE_LIMIT_BYTES), b"ping 1\n" + b"y" * (2 * LINE_LIMIT_BYTES), b"\xff\xfe\n"]
)
async def test_long_lines_and_garbage_end_the_connection(tmp_path: Path, sent: bytes):
    async with node(SecopService(), tmp_path) as port, talking(port) as talk:
        talk.writer.write(sent)
        assert b"ProtocolError" in (await talk.end() or b"ProtocolError")  # it may be reset before it is read
        async with talking(port) as other:
            assert (await other.asked("read chamber"))[0] == "reply"


async def test_requests_are_answered_in_their_order_whole_byte_by_byte_and_many_at_once(tmp_path: Path):
    async with node(SecopService(), tmp_path) as port, talking(port) as talk:
        for byte in b"ping 1\r\nping 2\n":
            talk.writer.write(bytes([byte]))
            await talk.writer.drain()
        assert [(await talk.line())[:6] for _ in range(2)] == ["pong 1", "pong 2"]
        talk.say(*(f"ping {number}" for number in range(200)))
        answers = [await talk.line() for _ in range(200)]
        assert [line.split(" ")[:2] for line in answers] == [["pong", str(number)] for number in range(200)]


async def test_one_more_is_admitted_and_strangers_leave_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(secop, "_SPEAK_WITHIN_S", 1.0)
    desk = SecopService()
    async with node(desk, tmp_path) as port, talking(port) as known:
        await known.ask("*IDN?")
        strangers = [await asyncio.open_connection("127.0.0.1", port) for _ in range(3 * secop.MOST_CLIENTS)]
        async with talking(port) as last:
            assert (await last.asked("do run:stop"))[0] == "done"
        assert (await known.asked("ping 1"))[0] == "pong"
        async with asyncio.timeout(LIMIT_S):
            assert [await reader.read() for reader, _ in strangers] == [b""] * len(strangers)
        for _, writer in strangers:
            writer.close()
    assert [verb for _, verb, _ in desk.orders] == ["stop"]


async def test_who_does_not_read_keeps_little_and_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(secop, "_SEND_LIMIT_S", 0.3)
    desk = SecopService()
    async with node(desk, tmp_path) as port, talking(port) as talk, talking(port) as other:
        talk.writer.transport.pause_reading()  # type: ignore[attr-defined]
        began_s = time.monotonic()
        with suppress(ConnectionError):
            while time.monotonic() < began_s + LIMIT_S:
                talk.say(*["describe"] * 50)
                await talk.writer.drain()
                assert (await other.asked("ping 1"))[0] == "pong"
        assert time.monotonic() < began_s + LIMIT_S


async def test_a_flood_of_requests_and_stops_delays_no_stop_of_another(tmp_path: Path):
    desk = SecopService()
    async with node(desk, tmp_path) as port, talking(port) as flood, talking(port) as other:

        async def pour() -> None:
            while True:
                flood.say(*["describe", "do run:stop"] * 20)
                await flood.writer.drain()

        async def drink() -> None:
            while await flood.reader.read(1 << 16):
                pass

        tasks = [asyncio.create_task(pour()), asyncio.create_task(drink())]
        waits: list[float] = []
        for _ in range(5):
            began_s = time.monotonic()
            assert (await other.asked("do run:stop"))[0] == "done"
            waits.append(time.monotonic() - began_s)
            await asyncio.sleep(0.1)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    assert sorted(waits)[2] < 1.0
    stops = sum(verb == "stop" for _, verb, _ in desk.orders)
    assert stops < 60  # at most ten a second are done, and recorded


async def test_hostile_lines_hurt_nobody(tmp_path: Path):
    """Drawn from a seed: words of the protocol, cut, joined and turned; the node goes on and orders nothing."""
    draw = random.Random(1)
    words = ["read", "change", "describe", "activate", "deactivate", "ping", "chamber", ":", "target", "do ", "value"]
    words += [
        " ",
        " ",
        "{}",
        "[1,",
        '"',
        "1e400",
        "-",
        "\x00",
        "\x1b[2J",
        "\ud800".encode("utf-16", "surrogatepass").decode("latin-1"),
        "ä",
        "<script>",
        "\r",
        "*IDN?",
    ]
    desk = SecopService()
    async with node(desk, tmp_path) as port:
        for _ in range(20):
            async with talking(port) as talk:
                talk.say("*IDN?")
                talk.say(*("".join(draw.choices(words, k=draw.randint(1, 8))) for _ in range(50)), "ping last")
                while not (line := await talk.line()).startswith(("pong last", "error_ping last")):
                    assert line
        async with talking(port) as talk:
            assert (await talk.asked("read chamber"))[0] == "reply"
    assert [order for order in desk.orders if order[2].get("verb") != "stop"] == []
