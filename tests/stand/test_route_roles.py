"""Which role each route needs: one table, that of the commands, asked over every route by each role."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.stand.fake_service import FakeService, serve_fake
from tests.stand.test_interface_access import NAMES, PROXIED, ask, free_port
from thermostand.stand.config.interface_section import ROLES, Role, SingleSignOnConfig, TokenFile, may
from thermostand.stand.service.stand_service import StandService
from thermostand.stand.serving.api.access import CHECK_PATH, INVITE_PATH, STOP_PATH, TokenStore
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api_models import DeviceState, DeviceVerb
from thermostand.stand.serving.commands import collect_commands

TOKENS: dict[Role, str] = {role: f"the-token-of-who-may-{role}" for role in ROLES}
API = "/api/v1"


class Desk(FakeService):
    def devices(self) -> tuple[DeviceState, ...]:
        verbs = (DeviceVerb(verb="open", text=""), DeviceVerb(verb="set", text="", role="commission"))
        return (DeviceState(name="flap", kind="flap", verbs=verbs),)


@asynccontextmanager
async def open_stand(folder: Path, single_sign_on: SingleSignOnConfig | None = None) -> AsyncIterator[tuple[Desk, int]]:
    known: dict[str, Role] = {"tokens": "commission", "operate": "operate", "read_only": "look"}
    tokens = TokenFile.model_validate({key: {role: TOKENS[role]} for key, role in known.items()})
    port, desk = free_port(), Desk()
    interface = Interface(folder, port=port, tokens=TokenStore(tokens), single_sign_on=single_sign_on)
    async with serve_fake(desk, folder / "cycle", interface):
        yield desk, port


async def asked(port: int, method: str, path: str, role: Role | None, body: object = None) -> tuple[int, Any]:
    headers = dict(PROXIED) | ({"Authorization": f"Bearer {TOKENS[role]}"} if role else {})
    content = None if body is None else json.dumps(body).encode()
    status, _, answer = await asyncio.to_thread(ask, port, method, path, headers, content)
    try:
        return status, json.loads(answer)
    except ValueError:
        return status, answer


async def test_each_route_is_refused_to_each_role_that_is_not_enough_and_to_no_other(tmp_path: Path):
    needs: dict[tuple[str, str], Role | None] = {
        (each.http, f"{API}{each.path}"): each.role for each in collect_commands(StandService).values()
    }
    needs["POST", f"{API}/overview/{{key}}/stop"] = None
    async with open_stand(tmp_path) as (_, port):
        _, document = await asked(port, "GET", "/openapi.json", "commission")
        tried = 0
        for path, entry in document["paths"].items():
            for method, described in entry.items():
                key = (method.upper(), path)
                needed = needs.get(key, "look")
                assert described.get("x-role", "look") == (needed or "none")
                for role in ROLES:
                    status, body = await asked(port, method.upper(), path.format(**NAMES), role, {})
                    is_refused = needed is not None and not may(role, needed)
                    # A body that is wrong is 422; who is refused does not get so far, or learns of the body first.
                    assert (status == 403) == is_refused or (status == 422 and is_refused), (key, role, status, body)
                    tried += 1
        assert tried > 3 * len(needs)
        assert {key for key in needs if key[1] not in document["paths"]} == set()


async def test_the_roles_of_the_commands_are_those_that_are_decided(tmp_path: Path):
    by_role: dict[str, set[str]] = {}
    for each in collect_commands(StandService).values():
        by_role.setdefault(str(each.role), set()).add(each.name)
    assert by_role.pop("None") == {"stop"}
    assert by_role.pop("commission") == {"reset"}
    assert list(by_role) == ["operate"]
    async with open_stand(tmp_path) as (_, port):
        _, known = await asked(port, "GET", f"{API}/commands", "look")
        assert {each["name"] for each in known if each["role"] == "commission"} == {"reset"}
        for path in (STOP_PATH, INVITE_PATH, CHECK_PATH):
            status, _ = await asked(
                port, "POST", path, "look", {"from_index": 0, "steps": []} if path == CHECK_PATH else None
            )
            assert status == 200
        assert (await asked(port, "POST", STOP_PATH, None))[0] == 200


@pytest.mark.parametrize(("verb", "expected"), [("open", [403, 200, 200]), ("set", [403, 403, 200])])
async def test_heat_by_hand_is_for_who_commissions_and_a_refusal_is_recorded(
    tmp_path: Path, verb: str, expected: list[int]
):
    async with open_stand(tmp_path) as (desk, port):
        path = f"{API}/devices/flap/{verb}"
        assert [(await asked(port, "POST", path, role, {}))[0] for role in ROLES] == expected
        assert [who.name for who, _, _ in desk.orders] == [
            role for role, status in zip(ROLES, expected, strict=True) if status == 200
        ]


async def test_a_trip_is_cleared_by_who_commissions_and_the_sentence_names_the_role(tmp_path: Path):
    async with open_stand(tmp_path) as (desk, port):
        desk.gate.hold("interlock")
        status, body = await asked(port, "POST", f"{API}/run/reset", "operate")
        assert (status, "reset needs the role commission, and the token of operate" in body["error"]) == (403, True)
        assert desk.gate.reasons == {"interlock"}
        assert (await asked(port, "POST", f"{API}/run/reset", "commission"))[0] == 200
        assert desk.gate.reasons == set()


async def test_a_proxy_that_the_file_names_says_who_asks_and_no_other_does(tmp_path: Path):
    users: dict[str, Role] = {"rose": "commission", "ann": "operate"}
    here = SingleSignOnConfig(proxies=("127.0.0.1",), users=users, others="look")
    elsewhere = here.model_copy(update={"proxies": ("192.0.2.1",)})

    async def who(port: int, *names: str) -> tuple[int, Any]:
        headers = {"X-Remote-User": names[0]} if names else {}
        status, _, answer = await asyncio.to_thread(ask, port, "GET", f"{API}/who", headers)
        return status, json.loads(answer)

    async with open_stand(tmp_path, here) as (desk, port):
        for name, role in (("rose", "commission"), ("ann", "operate"), ("eve", "look")):
            assert await who(port, name) == (200, {"name": name, "how": "proxy", "role": role})
        for wrong in ("", "a b", "<script>", "x" * 65):
            assert (await who(port, wrong))[0] == 401
        assert (await who(port))[0] == 401
        headers = {"X-Remote-User": "ann"}
        assert (await asyncio.to_thread(ask, port, "POST", f"{API}/run/pause", headers))[0] == 200
        assert (await asyncio.to_thread(ask, port, "POST", f"{API}/run/reset", headers))[0] == 403
        assert (await asyncio.to_thread(ask, port, "POST", INVITE_PATH, headers))[0] == 403
        assert [(each.name, each.how) for each, _, _ in desk.orders] == [("ann", "proxy")]
    (tmp_path / "other").mkdir()
    async with open_stand(tmp_path / "other", elsewhere) as (_, port):
        assert (await who(port, "rose"))[0] == 401


async def test_a_proxy_on_this_machine_makes_nobody_local_and_who_has_no_role_needs_a_token(tmp_path: Path):
    settings = SingleSignOnConfig(proxies=("127.0.0.1",), users={"rose": "commission"})
    interface = Interface(tmp_path, port=free_port(), single_sign_on=settings)  # no tokens: this machine may order
    async with serve_fake(FakeService(), tmp_path / "cycle", interface):
        port = interface.port or 0
        answers = [
            (await asyncio.to_thread(ask, port, "GET", f"{API}/who", headers))[0]
            for headers in ({}, {"X-Remote-User": "eve"}, {"X-Remote-User": "rose"})
        ]
        assert answers == [401, 401, 200]
