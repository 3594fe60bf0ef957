"""Faults on purpose while a stand is served, by the simulator that its file names: a real stand has none."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from thermostand.foundation.errors import ConfigError, Refused, Unreachable
from thermostand.stand.assembly.assemble import Assembly
from thermostand.stand.assembly.simulator import ControlSocket
from thermostand.stand.serving.api_models import Conflict, FaultRequest, Missing, SimulatedFaults

_ANSWERS_S = 5.0  # round number; nothing was measured


async def list_simulated_faults(assembly: Assembly) -> SimulatedFaults:
    """Return what can be broken, and what is. Conflict when this is a real stand, Unreachable when nobody simulates
    it."""
    async with _simulator(assembly) as simulator:
        return SimulatedFaults.model_validate(await simulator.request({"do": "faults"}))


async def break_or_mend(assembly: Assembly, request: FaultRequest) -> str:
    """Return what came of it, as a sentence. Missing when there is no such fault, ConfigError when the laboratory
    cannot have it; else as `list_simulated_faults`."""
    name, value = request.name, request.value
    async with _simulator(assembly) as simulator:
        try:
            known = SimulatedFaults.model_validate(await simulator.request({"do": "faults"})).faults
            if name not in {each.name for each in known}:
                raise Missing(f"there is no fault {name!r}; GET /api/v1/simulator/faults has those there are")
            if request.mend:
                await simulator.request({"do": "mend", "name": name})
                return f"{name} is mended"
            if value is None:
                value = next(each.worst for each in known if each.name == name)
            await simulator.request({"do": "break", "name": name, "value": value, "for_s": request.for_s})
        except Refused as error:
            raise ConfigError(error.text) from error
    return f"{name} is broken{f' for {request.for_s:g} s' if request.for_s else ''}"


@asynccontextmanager
async def _simulator(assembly: Assembly) -> AsyncGenerator[ControlSocket]:
    """Virtual time stands still meanwhile. Unreachable when the simulator does not answer."""
    simulation = assembly.config.simulation
    if simulation is None:
        raise Conflict(f"{assembly.config.name} is no simulated stand: nothing of it is broken on purpose")
    control = ControlSocket(simulation.control)
    with assembly.clock.hold():
        await control.open()
        try:
            async with asyncio.timeout(_ANSWERS_S):
                yield control
        except TimeoutError as error:
            raise Unreachable("simulator", f"no answer within {_ANSWERS_S:g} s; is its process stopped?") from error
        finally:
            await control.close()
