"""The order in which a stand is looked at: the computer, then device by device; with moves each moves when it answers.

The stand's addresses are locked as for a run, before anything is opened. Without moves no actuator is ever commanded;
with them everything that moved is made safe at the end, and closed.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, suppress
from functools import partial

from thermostand.drivers.devices.checking import Add, Finding, Look
from thermostand.drivers.devices.kinds import Equipment
from thermostand.drivers.settings import Identity
from thermostand.foundation.errors import DeviceError, InUse, Unreachable
from thermostand.stand.assembly import Assembly, register_map
from thermostand.stand.commissioning import host
from thermostand.stand.commissioning.moves import Moves
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.opening.open_stand import at_bench, made_safe
from thermostand.stand.running.opening.stop import Stop

COMMAND = "stand check"

Tell = Callable[[tuple[Finding, ...]], None]


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


async def _looks(assembly: Assembly, add: Add, *, has_moves: bool) -> AsyncIterator[None]:
    """Yields after each device."""
    for finding in await asyncio.to_thread(host.findings, assembly.config):
        add(finding)
    yield
    opened: set[str] = set()
    moves = Moves(assembly, opened, add) if has_moves else None
    is_bus_up = await _is_bus_up(assembly, add)
    yield
    for each in assembly.equipment:
        name, kind, settings = each
        device = assembly.devices.every[name]
        await kind.check(
            Look(
                device=device,
                settings=settings,
                section=kind.section,
                advise=partial(_advised, each),
                clock=assembly.clock,
                modbus=assembly.bus,
                is_bus_up=is_bus_up,
                made=assembly.devices.every,
                opened=opened,
                of_section=partial(getattr, assembly.config),
                map_of=register_map,
                add=add,
                is_powered_later=has_moves,
            )
        )
        if moves is not None:
            await moves.of(each)
        yield
    if moves is not None:
        await moves.cameras()
        yield


def _advised(each: Equipment, error: DeviceError) -> str:
    return each.kind.advise(error, each.name, each.settings)


async def _is_bus_up(assembly: Assembly, add: Add) -> bool:
    """The line that the units share."""
    try:
        await assembly.bus.open()
    except DeviceError as error:
        if isinstance(error, InUse):
            advice = "end the other program"
        elif assembly.config.simulation is not None:
            advice = "this stand is simulated: start its laboratory with `stand simulate FILE` in another terminal"
        else:
            advice = "is the adapter plugged in, its address right, and no other program using it? `stand devices`"
            advice += " lists the ports"
        add(Finding("bus", "link", "failed", error.text, advice))
        return False
    add(Finding("bus", "link", "ok", f"{assembly.bus.address} is open"))
    return True


async def _made_safe(assembly: Assembly, stop: Stop, found: list[Finding], tell: Tell) -> None:
    """Everything that may have moved; a failure when it is not confirmed."""
    if unsafe := await made_safe(assembly, stop):
        text = f"NOT SAFE: {'; '.join(unsafe)}"
        found.append(Finding("stand", "made safe", "failed", text, "look at the stand now"))
        tell((found[-1],))


def _identities(assembly: Assembly) -> dict[str, Identity]:
    """Of those that have answered."""
    known: dict[str, Identity] = {}
    for name, device in assembly.devices.every.items():
        with suppress(Unreachable):  # a camera that is not open
            if device.identity is not None:
                known[name] = device.identity
    return known
