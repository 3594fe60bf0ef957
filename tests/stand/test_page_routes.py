"""The routes of the page, asked as a browser asks them: its files, curves, frames, recorded sessions."""

import asyncio
import json
import re
import shutil
import urllib.error
import urllib.parse
import urllib.request
from contextlib import asynccontextmanager

import pytest
import pytest_asyncio

from tests.recording.full_session import make_half_second, record
from tests.stand.page_service import TARGET, frame_of, free_port, serve_cycle, target_image
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.stand.safety.gate import REASON_TEXTS
from thermostand.stand.serving.page_routes import PAGE

pytestmark = pytest.mark.asyncio(loop_scope="module")


@asynccontextmanager
async def serve_session(folder):
    port = free_port()
    async with serve_cycle(folder, port) as desk:
        desk.port, desk.folder = port, folder
        yield desk


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def recorded(tmp_path_factory):
    """For tests that only read it, and add recorded sessions of their own names."""
    async with serve_session(tmp_path_factory.mktemp("cycle") / "sessions") as desk:
        yield desk


@pytest_asyncio.fixture(loop_scope="module")
async def own_session(tmp_path, compiled_fit):
    """For tests that look at frames."""
    async with serve_session(tmp_path / "sessions") as desk:
        yield desk


def _read(url):
    try:
        with urllib.request.urlopen(url, timeout=60) as answer:
            return answer.status, dict(answer.headers), answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, dict(error.headers), error.read()


async def ask(desk, path):
    return await asyncio.to_thread(_read, f"http://127.0.0.1:{desk.port}{path}")


async def test_the_page_is_whole_and_lets_nothing_in_from_elsewhere(recorded):
    status, headers, text = await ask(recorded, "/")
    assert status == 200
    assert "script-src 'self'" in headers["content-security-policy"]
    assert "unsafe" not in headers["content-security-policy"]
    for path in PAGE.iterdir():
        found, _, data = await ask(recorded, f"/static/{path.name}")
        assert (found, data) == (200, path.read_bytes())
    assert b"<style" not in text
    assert b"style=" not in text
    own = [path for path in PAGE.iterdir() if path.suffix in (".js", ".css", ".html") and "uPlot" not in path.name]
    assert all("http://" not in path.read_text().replace("http://www.w3.org/2000/svg", "") for path in own)
    assert all("https://" not in path.read_text() for path in own)
    assert all("innerHTML" not in path.read_text() for path in own)


async def test_the_dark_changes_colours_only():
    """So axe's rules of colour are the only ones that are asked twice."""
    style = (PAGE / "page.css").read_text("utf-8")
    assert style.count("prefers-color-scheme") == 1
    (dark,) = re.findall(r"@media \(prefers-color-scheme: dark\) \{\s*:root \{([^{}]*)\}\s*\}", style)
    declared = [each.strip() for each in dark.split(";") if each.strip()]
    assert [each for each in declared if not re.fullmatch(r"--[\w-]+: #[0-9a-f]{6}", each)] == []


async def test_each_reason_to_hold_has_its_words():
    text = (PAGE / "notices.js").read_text("utf-8")
    assert [reason for reason in REASON_TEXTS if f"{reason}: " not in text] == []


@pytest.mark.parametrize(
    "name", ["../page_routes.py", "..%2Fpage_routes.py", "%2e%2e%2fapi_models.py", "nothing.js", ".", "%00"]
)
async def test_no_other_file_is_given(recorded, name):
    status, _, data = await ask(recorded, f"/static/{name}")
    assert status in (400, 404)
    assert "error" in json.loads(data)


async def test_curves_of_the_session_are_given_decimated(recorded):
    to_ns = recorded.clock.now_ns()
    path = (
        f"/api/v1/history?from_ns={recorded.began_ns}&to_ns={to_ns}&points=300&channels=thermometers.air,regulator.sp"
    )
    status, _, data = await ask(recorded, path)
    found = json.loads(data)
    assert status == 200
    assert set(found["low"]) == {"thermometers.air", "regulator.sp"}
    assert len(found["low"]["regulator.sp"]) == found["points"] <= 301
    assert max(value for value in found["low"]["regulator.sp"] if value is not None) == 52.0
    assert any(mark["kind"] == "device_lost" for mark in found["marks"])
    assert any(mark["level"] == "step" for mark in found["marks"])


@pytest.mark.parametrize(
    "query", ["from_ns=5&to_ns=5", "from_ns=9&to_ns=5", "from_ns=0&to_ns=5&points=0", "to_ns=5", "from_ns=a&to_ns=1"]
)
async def test_what_is_no_time_is_reported_in_a_sentence(recorded, query):
    status, _, data = await ask(recorded, f"/api/v1/history?{query}")
    assert status == 422
    assert json.loads(data)["error"]


async def test_before_the_first_frame_none_is_given_and_then_it_is(own_session):
    assert (await ask(own_session, "/api/v1/frame"))[0] == 204
    assert (await ask(own_session, "/api/v1/frame.jpg"))[0] == 204
    time_ns = own_session.clock.now_ns()
    own_session.hub.publish(frame_of(target_image(0, 0), time_ns))
    async with asyncio.timeout(120):
        while (await ask(own_session, "/api/v1/frame"))[0] == 204:
            await asyncio.sleep(0.2)
    status, _, data = await ask(own_session, "/api/v1/frame?camera=camera")
    found = json.loads(data)
    assert (status, found["time_ns"], len(found["markers"]), found["mean_px"]) == (200, time_ns, 54, 0.0)
    status, headers, picture = await ask(own_session, "/api/v1/frame.jpg")
    assert (status, headers["content-type"], picture[:2]) == (200, "image/jpeg", b"\xff\xd8")
    assert headers["cache-control"] == "no-store"
    assert (await ask(own_session, "/api/v1/frame?camera=other"))[0] == 404


async def test_a_recipe_is_given_as_a_document(recorded):
    status, _, data = await ask(recorded, "/api/v1/recipes/overnight")
    assert status == 200
    assert json.loads(data)["experiments"][1]["calibration"]["linear_mm"][0] == 0
    for name in ("..%2Fsimulated", "nothing", "Overnight", "%20"):
        assert (await ask(recorded, f"/api/v1/recipes/{name}"))[0] == 404


async def test_a_recorded_session_gives_its_curves(recorded):
    await record(recorded.folder / "one night", 12)
    status, _, data = await ask(recorded, f"/api/v1/sessions/{urllib.parse.quote('one night')}/history?points=100")
    found = json.loads(data)
    assert status == 200
    assert max(value for value in found["low"]["regulator.pv"] if value is not None) >= 31
    assert (await ask(recorded, "/api/v1/sessions/another/history"))[0] == 404
    shutil.rmtree(recorded.folder / "one night" / "telemetry")
    status, _, data = await ask(recorded, f"/api/v1/sessions/{urllib.parse.quote('one night')}/history")
    assert status in (404, 409)


@pytest.mark.usefixtures("compiled_fit")
async def test_the_drift_of_a_recorded_session_is_the_true_one(recorded):
    """Eight frames to fit after a reference; the target moves by 0.2 px a frame."""

    def items(time_ns, index):
        yield from (item for item in make_half_second(time_ns, index) if isinstance(item, Batch))
        parameters = {"frames": 1, "interval_s": 0.5, "role": "reference" if not index else "fit"}
        yield StepMark(time_ns, f"c{index}", index, "capture", StepState.STARTED, parameters)
        yield frame_of(target_image(0, 0.2 * index, (612, 512)), time_ns, f"c{index}")
        yield StepMark(time_ns, f"c{index}", index, "capture", StepState.DONE, parameters)

    await record(recorded.folder / "cycle", 9, items, attachments={"target.yaml": TARGET})
    status, _, data = await ask(recorded, "/api/v1/sessions/cycle/drift")
    found = json.loads(data)
    assert (status, found["camera"], found["trouble"]) == (200, "camera", "")
    means = [point["mean_px"] for point in found["points"]]
    assert means == pytest.approx([0.2 * index for index in range(9)], abs=0.05)
    assert found["points"][0]["time_ns"] < found["points"][-1]["time_ns"]


async def test_a_process_that_ends_is_a_warning_and_the_curves_go_on(own_session):
    events = []
    own_session.hub.subscribe(lambda item: isinstance(item, Event) and events.append(item))
    own_session.hub.publish(frame_of(target_image(0, 0), own_session.clock.now_ns()))
    async with asyncio.timeout(120):
        while (await ask(own_session, "/api/v1/frame"))[0] == 204:
            await asyncio.sleep(0.2)
    own_session.viewing._helper._process.kill()
    own_session.hub.publish(frame_of(target_image(0, 0), own_session.clock.now_ns()))
    async with asyncio.timeout(30):
        while not [event for event in events if event.kind == "preview"]:
            await asyncio.sleep(0.05)
    (reported,) = [event for event in events if event.kind == "preview"]
    assert reported.level == "warning"
    assert "killed by SIGKILL" in reported.text or "has ended" in reported.text
    curves = f"/api/v1/history?from_ns={own_session.began_ns}&to_ns={own_session.clock.now_ns()}"
    assert (await ask(own_session, curves))[0] == 200
    assert (await ask(own_session, "/api/v1/frame"))[0] == 200  # the last one stays


async def test_frames_are_skipped_and_never_queued(own_session):
    """A hundred at once: the newest is what is looked at."""
    time_ns = own_session.clock.now_ns()
    for frame in [frame_of(target_image(0, 0, (612, 512)), time_ns + index) for index in range(100)]:
        own_session.hub.publish(frame)
    async with asyncio.timeout(120):
        while (answer := await ask(own_session, "/api/v1/frame"))[0] == 204:
            await asyncio.sleep(0.2)
        while (found := json.loads(answer[2]))["time_ns"] != time_ns + 99:
            answer = await ask(own_session, "/api/v1/frame")
            await asyncio.sleep(0.1)
    assert found["skipped"] >= 97
