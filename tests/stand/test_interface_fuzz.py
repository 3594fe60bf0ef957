"""Whatever is asked by the published OpenAPI document, and against it: no answer is a 500, each is a sentence and of a
status that the document has, and what fits the document is not called wrong."""

import asyncio
import http.client
import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.stand.fake_service import FakeService, serve_fake
from tests.stand.test_interface_access import ask, free_port
from thermostand.stand.serving.api.listeners import Interface

_QUICK, _LONG = 8, 400  # examples of each operation
_REFUSED_UNREAD = 400
"""A head that is no HTTP is answered, and the connection ended, while the body is still on its way: the answer may be
lost with it."""


class Broken(FakeService):
    """A desk of which one command fails in a way that nobody has thought of."""

    def reset(self, who):
        raise ZeroDivisionError("nobody has thought of it")


def answered(
    port: int, method: str, path: str, query: object, headers: dict[str, str], body: bytes
) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    try:
        target = path + (f"?{query}" if query else "")
        connection.putrequest(method, target, skip_host=True, skip_accept_encoding=True)
        connection.putheader("Host", "localhost")
        for name, value in headers.items():
            if name.lower() not in ("host", "content-length", "connection", "transfer-encoding"):
                connection.putheader(name, value)
        connection.putheader("Content-Length", str(len(body)))
        try:
            connection.endheaders(body)
            answer = connection.getresponse()
            return answer.status, answer.read()
        except (BrokenPipeError, ConnectionResetError):
            if not body:
                raise
            return _REFUSED_UNREAD, b'{"error": ""}'
    finally:
        connection.close()


def fuzz(port: int, examples: int) -> tuple[list[str], Counter[int]]:
    """What was answered as it must not be, and how often which status."""
    import schemathesis  # which takes a second, also where nothing is fuzzed

    wrong, seen = list[str](), Counter[int]()
    document = json.loads(answered(port, "GET", "/openapi.json", "", {}, b"")[1])
    schema = schemathesis.openapi.from_dict(document)
    for operation in (each.ok() for each in schema.get_all_operations()):
        modes = [schemathesis.GenerationMode.POSITIVE, schemathesis.GenerationMode.NEGATIVE]
        cases = st.one_of([operation.as_strategy(generation_mode=mode) for mode in modes])

        @settings(
            max_examples=examples,
            deadline=None,
            derandomize=True,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large],
        )
        @given(case=cases)
        def ask(case: schemathesis.Case) -> None:
            request = case.as_transport_kwargs(base_url="http://localhost")
            prepared = _prepared(request)
            status, text = answered(port, *prepared)
            seen[status] += 1
            is_valid = case.meta is not None and case.meta.generation.mode is schemathesis.GenerationMode.POSITIVE
            is_documented = str(status) in document["paths"][case.path][case.method.lower()]["responses"]
            is_wrong = (is_valid and status in (400, 422)) or not is_documented
            if is_wrong or status >= 500 or (status >= 400 and "error" not in json.loads(text)):
                wrong.append(f"{prepared}: {status} {text[:300]!r}")

        ask()
    return wrong, seen


def _prepared(request: dict[str, Any]) -> tuple[str, str, str, dict[str, str], bytes]:
    from requests import Request  # what schemathesis gives is for it

    prepared = Request(**{name: value for name, value in request.items() if name != "timeout"}).prepare()
    path, _, query = prepared.path_url.partition("?")
    body: Any = prepared.body or b""
    data = body.encode() if isinstance(body, str) else bytes(body)
    headers = {name: value if isinstance(value, str) else value.decode("latin-1") for name, value in _of(prepared)}
    return prepared.method or "GET", path, query, headers, data


def _of(prepared: Any) -> list[tuple[str, Any]]:
    return list(prepared.headers.items())


@pytest.mark.parametrize("examples", [_QUICK, pytest.param(_LONG, marks=pytest.mark.nightly)])
async def test_no_request_by_the_document_or_against_it_makes_a_500(tmp_path: Path, examples: int):
    port = free_port()
    desk = FakeService("interlock")
    async with serve_fake(desk, tmp_path / "cycle", Interface(tmp_path, port=port)):
        wrong, seen = await asyncio.to_thread(fuzz, port, examples)
        assert (await asyncio.to_thread(answered, port, "GET", "/healthz", "", {}, b""))[0] == 200
    assert wrong == []
    assert desk.orders
    assert min(seen[200], seen[404], seen[422]) > 10, seen


async def test_a_method_that_is_not_done_at_an_address_is_answered_with_those_that_are(tmp_path: Path):
    port = free_port()
    async with serve_fake(FakeService(), tmp_path / "cycle", Interface(tmp_path, port=port)):
        document = json.loads((await asyncio.to_thread(ask, port, "GET", "/openapi.json"))[2])
        for path, entry in document["paths"].items():
            status, headers, _ = await asyncio.to_thread(ask, port, "OPTIONS", path.replace("{run}", "1"))
            methods = {method.upper() for method in entry} | ({"HEAD"} if "get" in entry else set())
            assert (status, set(headers["allow"].split(", "))) == (405, methods), path


async def test_what_fails_is_answered_with_a_sentence_published_as_an_event_and_hurts_nobody(tmp_path: Path):
    port, desk = free_port(), Broken()
    events: list[str] = []
    desk.hub.subscribe(lambda item: events.append(getattr(item, "text", "")))
    async with serve_fake(desk, tmp_path / "cycle", Interface(tmp_path, port=port)):
        for _ in range(3):
            status, text = await asyncio.to_thread(answered, port, "POST", "/api/v1/run/reset", "", {}, b"")
            assert (status, "ZeroDivisionError" in json.loads(text)["error"]) == (500, True)
        assert (await asyncio.to_thread(answered, port, "GET", "/healthz", "", {}, b""))[0] == 200
        await asyncio.sleep(0)
    assert len([text for text in events if "nobody has thought" in text]) == 1
