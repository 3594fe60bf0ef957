"""A stand in Foxglove, read by a viewer that speaks its protocol (foxglove.sdk.v1) and was written here."""

import asyncio
import json
import socket
import struct
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from tests.addresses import find_free_port
from thermostand.foundation.readings import Quality
from thermostand.stand.serving.api_models import HeatByHand, ReadingState, StandState

live = pytest.importorskip("thermostand.stand.commands.foxglove_live")
NOW_NS = 1_795_000_000_000_000_000
UTC_NS = 5_000_000_000
_DATA = struct.Struct("<BIQ")  # opcode, subscription, time


def state(air_degC: float, time_ns: int) -> StandState:
    readings = {
        "thermometers.air": ReadingState(value=air_degC, unit="degC", quality=Quality.GOOD, time_ns=time_ns),
        "thermometers.granite": ReadingState(
            value=None, unit="degC", quality=Quality.BAD, time_ns=time_ns, reason="broken"
        ),
    }
    return StandState(
        stand="a stand",
        version="0",
        simulated=True,
        now_ns=time_ns,
        utc_offset_ns=UTC_NS,
        phase="idle",
        readings=readings,
        setpoint_degC=30.0,
    )


async def fetch(viewer: ClientConnection, wanted: str) -> dict[str, Any]:
    """The next message of that kind in JSON."""
    async with asyncio.timeout(20):
        while True:
            got = await viewer.recv()
            if isinstance(got, str) and (message := json.loads(got))["op"] == wanted:
                return message


async def data(viewer: ClientConnection) -> tuple[int, int, bytes]:
    """The next message of a channel: subscription, time and content."""
    async with asyncio.timeout(20):
        while isinstance(got := await viewer.recv(), str):
            pass
    opcode, subscription, time_ns = _DATA.unpack_from(got)
    assert opcode == 1
    return subscription, time_ns, got[_DATA.size :]


async def test_a_viewer_gets_readings_state_events_and_the_last_frame_and_cannot_write():
    port = find_free_port()
    published = live.FoxgloveServer("a stand", port)
    pictures = [(NOW_NS, b"\xff\xd8 a picture")]
    asked: list[int] = []

    def picture() -> tuple[int, bytes] | None:
        asked.append(1)
        return pictures[-1]

    try:
        published.state(state(24.0, NOW_NS))  # channels appear with their first values
        published.publish_picture(picture)
        assert asked == []  # nobody looks
        url = f"ws://127.0.0.1:{port}"
        async with connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")]) as viewer:
            assert (await fetch(viewer, "serverInfo"))["capabilities"] == []
            channels: dict[str, int] = {}
            while len(channels) < 4:
                channels |= {each["topic"]: each["id"] for each in (await fetch(viewer, "advertise"))["channels"]}
            assert set(channels) == {"/state", "/events", "/camera", "/readings/thermometers"}
            numbers = {topic: number for number, topic in enumerate(channels, 1)}
            asks = [{"id": numbers[topic], "channelId": channel} for topic, channel in channels.items()]
            await viewer.send(json.dumps({"op": "subscribe", "subscriptions": asks}))
            while not published._camera.has_sinks():
                await asyncio.sleep(0.01)
            by_hand = HeatByHand(setpoint_degC=40.0, since_ns=NOW_NS)
            published.state(state(25.5, NOW_NS + 1).model_copy(update={"by_hand": by_hand}))
            event = {
                "time_ns": NOW_NS,
                "utc_offset_ns": UTC_NS,
                "level": "error",
                "kind": "tripped",
                "text": "too warm",
            }
            published.event(event)
            published.publish_picture(picture)
            published.publish_picture(picture)  # the same one is not sent again
            got = {
                subscription: (time_ns, content)
                for subscription, time_ns, content in [await data(viewer) for _ in range(4)]
            }
    finally:
        published.close()
    time_ns, content = got[numbers["/readings/thermometers"]]
    assert (time_ns, json.loads(content)) == (NOW_NS + 1 + UTC_NS, {"air": 25.5, "granite": None})
    snapshot = json.loads(got[numbers["/state"]][1])
    assert (snapshot["setpoint_degC"], snapshot["by_hand_setpoint_degC"]) == (30.0, 40.0)
    assert b"too warm" in got[numbers["/events"]][1]
    assert got[numbers["/camera"]][0] == NOW_NS + UTC_NS
    assert b"a picture" in got[numbers["/camera"]][1]
    assert len(asked) == 2


def test_a_taken_port_is_reported():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises((OSError, RuntimeError)):
            live.FoxgloveServer("a stand", taken.getsockname()[1])
