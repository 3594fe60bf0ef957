"""The stream of a stand: numbers, replay, what is gone, and viewers who are slow."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, connect, unix_connect
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode

from tests.daemon_queries import ask
from tests.stand.fake_service import FakeService, serve_fake
from tests.stand.test_interface_access import free_port
from thermostand.foundation.items import StepMark, StepState
from thermostand.stand.serving.api import stream as streams
from thermostand.stand.serving.api.bridge import Bridge, NoAnswer
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api.stream import MOST_VIEWERS, Stream
from thermostand.stand.serving.api_models import StandState
from thermostand.stand.serving.client import find_session_server
from thermostand.stand.serving.instances import list_daemons


async def message(viewer: ClientConnection) -> dict[str, Any]:
    async with asyncio.timeout(20):
        return json.loads(await viewer.recv())


async def until(viewer: ClientConnection, kind: str) -> dict[str, Any]:
    while (got := await message(viewer))["type"] != kind:
        pass
    return got


@asynccontextmanager
async def opened(tmp_path: Path, desk: FakeService) -> AsyncIterator[str]:
    port = free_port()
    async with serve_fake(desk, tmp_path / "cycle", Interface(tmp_path, port=port)):
        yield f"ws://127.0.0.1:{port}/api/v1/stream"


async def test_a_viewer_gets_the_state_then_what_happens_in_order_with_numbers(tmp_path: Path):
    desk = FakeService()
    async with opened(tmp_path, desk) as url, connect(url) as viewer:
        state = await message(viewer)
        assert state["type"] == "state"
        assert StandState.model_validate(state["data"]).readings["thermometers.granite"].value is None
        desk.tell("first", value=1)
        desk.hub.publish(desk.batch(22.0))
        desk.hub.publish(StepMark(1, "3-soak", 3, "soak", StepState.STARTED, {"duration_s": 60.0}))
        desk.tell("last")
        got = [await until(viewer, kind) for kind in ("event", "reading", "event", "event")]
        assert [each["seq"] for each in got] == list(range(state["seq"] + 1, state["seq"] + 5))
        assert (got[0]["data"]["kind"], got[0]["data"]["data"]) == ("reported", {"value": 1})
        assert got[1]["data"]["readings"]["thermometers.air"]["value"] == 22.0
        assert got[1]["data"]["readings"]["thermometers.granite"]["value"] is None
        assert (got[2]["data"]["kind"], got[2]["data"]["data"]["step_id"]) == ("step", "3-soak")
        later = await until(viewer, "state")
        assert later["data"]["readings"]["thermometers.air"]["value"] == 22.0


async def test_a_command_is_an_event_with_its_number_and_who_gave_it(tmp_path: Path):
    desk = FakeService()
    async with opened(tmp_path, desk) as url, connect(url) as viewer:
        await message(viewer)
        done = await asyncio.to_thread(ask, tmp_path / "cycle", "pause")
        event = await until(viewer, "event")
        assert event["seq"] == done["seq"]
        who = desk.orders[0][0]
        assert event["data"]["kind"] == "command"
        assert event["data"]["data"] == {
            "who": who.name,
            "how": "socket",
            "verb": "pause",
            "arguments": {"when": "now"},
            "result": "done",
        }
        assert (await until(viewer, "state"))["data"]["reasons"] == ["operator"]


async def test_a_client_that_reconnects_gets_what_was_missed_and_learns_what_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(streams, "EVENTS", 10)
    desk = FakeService()
    async with opened(tmp_path, desk) as url:
        async with connect(url) as viewer:
            first = (await message(viewer))["seq"]
        for number in range(4):
            desk.tell(str(number))
        async with connect(f"{url}?from={first + 1}") as viewer:
            got = [await message(viewer) for _ in range(4)]
            assert [(each["type"], each["seq"] - first) for each in got[:3]] == [
                ("event", 2),
                ("event", 3),
                ("event", 4),
            ]
            assert got[3]["type"] == "state"  # as it was last published, twice a second: perhaps before these events
            assert 0 <= got[3]["seq"] - first <= 4
        for number in range(20):
            desk.tell(str(number))
        async with connect(f"{url}?from={first}") as viewer:
            gone = await message(viewer)
            assert gone["type"] == "gone"
            assert (gone["data"]["first"], gone["data"]["last"]) == (first + 1, first + 14)
            assert gone["data"]["types"] == ["event"]
            assert [(await message(viewer))["seq"] - first for _ in range(10)] == list(range(15, 25))
        async with connect(f"{url}?from={first + 1_000_000}") as viewer:  # of a daemon that is no more
            assert (await message(viewer))["type"] == "gone"
            assert (await message(viewer))["seq"] == first + 15
        found = await asyncio.to_thread(
            find_session_server(tmp_path / "cycle").request, "GET", f"/api/v1/events?from={first + 20}"
        )
        assert isinstance(found, dict)
        assert (found["gone"], [each["text"] for each in found["events"]]) == (False, ["16", "17", "18", "19"])


async def test_a_viewer_who_does_not_read_loses_the_oldest_and_learns_of_it():
    desk = FakeService()
    bridge = Bridge(desk)
    stream = Stream(bridge)
    slow, quick = stream.join(None), stream.join(None)
    assert [json.loads(await viewer.next())["type"] for viewer in (slow, quick)] == ["state", "state"]
    last = 0
    for number in range(2000):
        desk.tell(str(number))
        stream.pump()
        while last < number + 1:
            got = json.loads(await quick.next())
            last += got["type"] == "event"
    got = [json.loads(await slow.next()) for _ in range(2)]
    assert [each["type"] for each in got] == ["gone", "event"]
    assert got[0]["data"]["drops"] == slow.drops == 2000 - 512
    assert got[1]["data"]["text"] == str(2000 - 512)
    assert quick.drops == stream.drops == 0
    bridge.close()


async def test_what_nobody_takes_is_dropped_and_counted():
    desk = FakeService()
    bridge = Bridge(desk)
    stream = Stream(bridge)
    for number in range(25_000):
        desk.tell(str(number))
    stream.pump()
    assert stream.drops == 5_000
    bridge.close()


async def test_a_control_loop_that_hangs_is_reported_and_orders_time_out():
    desk = FakeService()
    bridge = Bridge(desk)

    async def never(_: object) -> None:
        await asyncio.Event().wait()

    with pytest.raises(NoAnswer, match=r"within 0\.05 s"):
        await bridge.ask(never, 0.05)
    bridge.close()
    with pytest.raises(NoAnswer, match="the daemon is ending"):
        await bridge.ask(lambda desk: desk.state(), 1.0)


async def test_viewers_beyond_the_most_are_refused_and_cost_nobody_a_place(tmp_path: Path):
    desk = FakeService()
    async with opened(tmp_path, desk) as url:
        viewers = [await connect(url) for _ in range(MOST_VIEWERS)]
        with pytest.raises(Exception, match="503"):
            await connect(url)
        assert (await asyncio.to_thread(ask, tmp_path / "cycle", "stop"))["verb"] == "stop"
        for viewer in viewers:
            assert (await message(viewer))["type"] == "state"
            await viewer.close()
        async with asyncio.timeout(20):
            while True:
                try:
                    viewer = await connect(url)
                    break
                except Exception:  # noqa: BLE001 - until the daemon has seen that the others have left
                    await asyncio.sleep(0.05)
        await viewer.close()


async def test_the_unix_socket_has_the_stream_too(tmp_path: Path):
    desk, session = FakeService(), tmp_path / "cycle"
    async with serve_fake(desk, session):
        (daemon,) = [each for each in list_daemons() if each.entry.session == str(session)]
        async with unix_connect(str(daemon.socket), "ws://localhost/api/v1/stream") as viewer:
            assert (await message(viewer))["data"]["stand"] == "a stand"


async def flooding(viewer: ClientConnection, what: str) -> None:
    """Until it is disconnected."""
    for number in range(20_000):
        if what == "pings":
            await viewer.ping(f"{number}")
        else:
            await viewer.send("x" if what == "texts" else "x" * 200_000)
    await viewer.recv()
    await viewer.wait_closed()
    await viewer.ping()


@pytest.mark.parametrize("sent", ["pings", "texts", "one large text"])
async def test_a_viewer_that_sends_is_disconnected_and_takes_no_stop_away(tmp_path: Path, sent: str):
    desk = FakeService()
    async with opened(tmp_path, desk) as url, connect(url, max_size=None) as viewer, connect(url) as quiet:
        await until(quiet, "state")
        with pytest.raises(ConnectionClosed):
            await flooding(viewer, sent)
        assert viewer.close_code in (CloseCode.POLICY_VIOLATION, CloseCode.MESSAGE_TOO_BIG, CloseCode.ABNORMAL_CLOSURE)
        assert (await asyncio.to_thread(ask, tmp_path / "cycle", "stop"))["verb"] == "stop"
        assert await quiet.ping()
    assert [verb for _, verb, _ in desk.orders] == ["stop"]


async def test_between_the_messages_of_a_replay_others_have_their_turn():
    viewer, turns = streams.Viewer(streams.StreamMessage(seq, "event", "{}") for seq in range(100)), 0

    async def take_turns() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    other = asyncio.create_task(take_turns())
    for _ in range(100):
        await viewer.next()
    other.cancel()
    assert turns >= 99
