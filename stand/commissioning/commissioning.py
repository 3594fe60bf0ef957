"""The order in which a stand is looked at: the computer, then device by device; with moves each moves when it answers.

The stand's addresses are locked as for a run, before anything is opened. Without moves no actuator is ever commanded;
with them everything that moved is made safe at the end, and closed.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack
from functools import partial

from thermostand.drivers.devices.protocols import Actuator
from thermostand.drivers.settings import Identity
from thermostand.foundation.errors import Unreachable
from thermostand.stand.assembly import Assembly
from thermostand.stand.commissioning import host
from thermostand.stand.commissioning.camera_line_check import shared_lines
from thermostand.stand.commissioning.finding import Finding
from thermostand.stand.commissioning.links import Links
from thermostand.stand.commissioning.moves import Moves
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.opening.open_stand import at_bench, made_safe
from thermostand.stand.running.opening.stop import Stop

COMMAND = "stand check"

Tell = Callable[[tuple[Finding, ...]], None]
Work = Callable[[], Awaitable[None]]


async def commission(
    config: StandConfig, tell: Tell, *, has_moves: bool
) -> tuple[tuple[Finding, ...], dict[str, Identity]]:
    """Everything that was found, reported group by group as it is found, and which devices have answered.

    InUse when the stand belongs to another program: then nothing was touched. Interrupted when it was stopped, and
    ConfigError.
    """
    found: list[Finding] = []
    async with AsyncExitStack() as stack:
        stop = await stack.enter_async_context(Stop())
        assembly = await stack.enter_async_context(at_bench(config, COMMAND))
        if has_moves:
            stack.push_async_callback(_made_safe, assembly, stop, found, tell)
            stop.watch(assembly.stand)
        reported = 0
        async for _ in _looks(assembly, found.append, has_moves=has_moves):
            tell(tuple(found[reported:]))
            reported = len(found)
        return tuple(found), _identities(assembly)


async def _looks(assembly: Assembly, add: Callable[[Finding], None], *, has_moves: bool) -> AsyncIterator[None]:
    """Yields after each device."""
    for finding in await asyncio.to_thread(host.findings, assembly.config):
        add(finding)
    yield
    devices, links = assembly.devices, Links(assembly, add)
    moves = Moves(assembly, links, add) if has_moves else None

    async def look(link: Work, actuator: Actuator | None = None, move: Work | None = None) -> None:
        await link()
        if moves is None:
            return
        if actuator is not None and actuator.name in links.opened:
            assembly.stand.opened(actuator)
        if move is not None:
            await move()

    await look(links.bus)
    yield
    await look(links.regulator, devices.regulator)
    yield
    await look(links.thermometers)
    yield
    await look(links.relays, devices.relays, moves and moves.heat_timer)
    yield
    await look(links.heat_module)
    yield
    await look(links.inputs)
    yield
    for name in devices.probes:
        await links.probe(name)
        yield
    await links.imager()
    yield
    await look(links.flap, devices.flap, moves and moves.flap)
    yield
    for name, axis in devices.axes.items():
        await look(partial(links.axis, name), axis, moves and partial(moves.axis, name))
        yield
    for name in devices.cameras:
        await links.camera(name, is_switched_on_later=has_moves)
        for finding in shared_lines(assembly.config, name):
            add(finding)
    if moves is not None:
        await moves.cameras()
    yield


async def _made_safe(assembly: Assembly, stop: Stop, found: list[Finding], tell: Tell) -> None:
    """Everything that may have moved; a failure when it is not confirmed."""
    if unsafe := await made_safe(assembly, stop):
        text = f"NOT SAFE: {'; '.join(unsafe)}"
        found.append(Finding("stand", "made safe", "failed", text, "look at the stand now"))
        tell((found[-1],))


def _identities(assembly: Assembly) -> dict[str, Identity]:
    """Of those that have answered."""
    devices = assembly.devices
    known: dict[str, Identity] = {}
    units = (devices.regulator, devices.relays, devices.heat_module, devices.thermometers, devices.inputs, devices.flap)
    for device in (*units, *devices.axes.values(), *devices.cameras.values()):
        try:
            identity = None if device is None else device.identity
        except Unreachable:  # a camera that is not open
            continue
        if device is not None and identity is not None:
            known[device.name] = identity
    return known
