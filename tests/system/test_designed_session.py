"""A session that is designed at a daemon: previewed, saved as a recipe of one's own, rehearsed; over its interface."""

import json
import shutil
from pathlib import Path

import pytest

from tests.system.test_daemon import BRIEF, is_idle, serve
from thermostand.foundation.errors import SessionError
from thermostand.recording.reading.catalogue import inspect_session

__all__ = ["serve"]


def test_a_design_is_previewed_saved_rehearsed_and_removed(serve):
    served = serve()
    served.until(is_idle)
    seen = served.post("previews", recipe_text=BRIEF)
    assert (seen["begins"], seen["ahead"], seen["steps"], seen["lacks"]) == ("now", 0, 3, [])
    assert seen["recipe"]["steps"] == [{"start_chamber": 26}, {"soak": 0.5}, "stop_chamber"]
    assert served.state().queue == ()  # nothing was queued

    put = served.server.request("PUT", "/api/v1/own-recipes/brief", {"recipe_text": BRIEF}, 20.0)
    assert put["verb"] == "save_recipe"
    for name, text in (("other", BRIEF), ("demo", BRIEF.replace("brief", "demo")), ("brief", "steps: 3")):
        with pytest.raises(SessionError):  # another name, an installed one's, no recipe
            served.server.request("PUT", f"/api/v1/own-recipes/{name}", {"recipe_text": text}, 20.0)
    known = served.server.request("GET", "/api/v1/recipes", None, 20.0)
    assert [each["name"] for each in known if each["own"]] == ["brief"]
    assert served.server.request("GET", "/api/v1/recipes/brief", None, 20.0)["name"] == "brief"

    served.post("rehearsals", recipe="brief")
    served.until(lambda _: _find_event(served, "rehearsed") is not None)
    session = _find_event(served, "rehearsed")["data"]["session"]
    assert inspect_session(served.out / session).simulated
    assert served.state().queue == ()  # a rehearsal is no run of the stand

    served.server.request("DELETE", "/api/v1/own-recipes/brief", None, 20.0)
    with pytest.raises(SessionError):
        served.post("previews", recipe="brief")


def _find_event(served, kind):
    events = served.server.request("GET", "/api/v1/events?limit=200", None, 20.0)["events"]
    assert not [each for each in events if each.get("kind") == "not_rehearsed"], json.dumps(events[-3:])
    return next((each for each in events if each.get("kind") == kind), None)


def test_a_file_that_is_no_recipe_spoils_no_list_and_a_disk_that_refuses_is_an_answer(serve):
    served = serve()
    served.until(is_idle)
    folder = served.out / "recipes"
    folder.mkdir()
    (folder / "broken.yaml").write_bytes(b"\xff\xfe name")
    (folder / "scalar.yaml").write_text("3")
    assert {"broken", "scalar"} < {each["name"] for each in served.server.request("GET", "/api/v1/recipes", None, 20.0)}
    for name in ("broken", "scalar"):
        with pytest.raises(SessionError, match=name):
            served.server.request("GET", f"/api/v1/recipes/{name}", None, 20.0)
    shutil.rmtree(folder)
    folder.write_text("a file where a folder should be")
    with pytest.raises(SessionError, match="recipes"):
        served.server.request("PUT", "/api/v1/own-recipes/brief", {"recipe_text": BRIEF}, 20.0)
    assert is_idle(served.state())


def test_a_daemon_that_ends_leaves_no_rehearsal_behind(serve):
    served = serve()
    served.until(is_idle)
    served.post("rehearsals", recipe="overnight")
    mine = f"--out\0{served.out}\0".encode()

    def rehearsing() -> bool:
        found = Path("/proc").glob("[0-9]*/cmdline")
        return any(mine in _read(path) and b"--virtual-time" in _read(path) for path in found)

    served.until(lambda _: rehearsing())
    served.process.terminate()
    served.reported()
    assert not rehearsing()


def _read(path):
    try:
        return path.read_bytes()
    except OSError:  # it has ended
        return b""
