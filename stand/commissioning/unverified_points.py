"""Points of a register map that were never seen on a unit: read back, compared with what the map expects, and shown."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby

from thermostand.drivers.wires.bus import Bus
from thermostand.drivers.wires.modbus_unit import ModbusUnit, Sample
from thermostand.drivers.wires.registers import RegisterMap
from thermostand.foundation.errors import DeviceError, Refused
from thermostand.stand.commissioning.finding import Finding, Verdict


async def unverified_points(
    device: str, bus: Bus, register_map: RegisterMap, used: Iterable[str] | None = None
) -> tuple[Finding, ...]:
    """A finding for each remark `unverified` of the map, with what its points read; of the points `used` only, when
    given. A point that has an expected value is decided by it."""
    unit, points = ModbusUnit(device, bus, register_map), register_map.points
    wanted = set(points) if used is None else {*used, *(field.point for field in register_map.identity.values())}
    names = [name for name, point in points.items() if point.unverified and name in wanted]
    found: list[Finding] = []

    def remark_of(name: str) -> str:
        return points[name].unverified

    for remark, group in groupby(sorted(names, key=remark_of), remark_of):
        found.append(await _read_back(unit, tuple(group), remark))
    return tuple(found)


async def _read_back(unit: ModbusUnit, names: tuple[str, ...], remark: str) -> Finding:
    what = f"point{'' if len(names) == 1 else 's'} {', '.join(names)}"
    shown, data = list[str](), dict[str, object]()
    for name in names:
        point = unit.map.points[name]
        try:
            sample = (await unit.snapshot([name])).samples[name]
        except DeviceError as error:
            known = "has no such point" if isinstance(error, Refused) else "does not answer for it"
            advice = (
                f"correct {name} in the map {unit.map.model}, or take it out; it was never seen on a unit: {remark}"
            )
            text = f"the unit {known} ({point.space} {point.address:#06x}): {error.text}"
            is_needed = name not in {field.point for field in unit.map.identity.values()}
            verdict: Verdict = "failed" if is_needed else "warning"
            return Finding(unit.name, what, verdict, text, advice, data)
        data[name] = sample.raw
        shown.append(_shown(unit.map, name, sample))
        expected = next((probe.expect for probe in unit.map.probe if probe.point == name), None)
        if expected is not None and sample.value == expected:
            text = f"{name} reads {shown[-1]}, as its map expects"
            return Finding(unit.name, what, "ok", text, data=data)
    text = f"reads {', '.join(shown)}"
    advice = f"never seen on a unit: {remark}; when it is right, take `unverified` out of the register map"
    return Finding(unit.name, what, "unverified", text, advice, data)


def _shown(register_map: RegisterMap, name: str, sample: Sample) -> str:
    if sample.reason:
        return sample.reason
    if any(field.point == name and field.shown == "hex" for field in register_map.identity.values()):
        return f"{sample.raw:#x}"
    unit = register_map.points[name].unit
    return f"{sample.value:.4g}{'' if unit == '1' else f' {unit}'}"
