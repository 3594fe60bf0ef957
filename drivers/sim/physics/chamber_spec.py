"""What one simulated chamber is made of: heat capacities, conductances, powers and lags of its thermal network.

Temperatures are in degC, heat capacities in J/K, conductances in W/K. The chamber is a chest freezer of
1.2 x 0.9 x 0.8 m; its evaporator is bonded to the liner and the fan-heater stirs the air. It reaches -10 to +70 degC.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, fields, replace


@dataclass(frozen=True, slots=True)
class ChamberSpec:
    """The standard chamber; another one has other numbers.

    air: 0.86 m3 of air, ducts and racks. wall: the steel liner with the evaporator's tubes; wall_laboratory: the
    insulation. flap_leak: exchange of air through the open flap. heater: lag 25 s. coil: the evaporator, lag 60 s.
    compressor_W: at an evaporator of 0 degC and above, where the motor limits it; compressor_per_K: capacity lost per K
    of evaporator below that (suction pressure). granite: slab through the wall, lag inside over an hour. probe_lag_s,
    near_lag_s: of the regulator's probe and of the thermometer near the camera. body: the camera's housing.
    """

    air_J_K: float = 6_000.0
    wall_J_K: float = 40_000.0
    air_wall_W_K: float = 60.0
    wall_laboratory_W_K: float = 8.0
    fan_W: float = 20.0
    flap_leak_W_K: float = 12.0
    heater_W: float = 2_000.0
    heater_J_K: float = 500.0
    heater_air_W_K: float = 20.0
    coil_J_K: float = 2_500.0
    coil_wall_W_K: float = 38.0
    coil_air_W_K: float = 4.0
    compressor_W: float = 600.0
    compressor_per_K: float = 0.010
    granite_J_K: float = 60_000.0
    granite_air_W_K: float = 14.0
    granite_inside_outside_W_K: float = 0.6
    granite_laboratory_W_K: float = 9.0
    probe_lag_s: float = 10.0
    near_lag_s: float = 40.0
    body_J_K: float = 120.0
    body_air_W_K: float = 0.19


_CONDUCTANCES = tuple(field.name for field in fields(ChamberSpec) if field.name.endswith("_W_K"))
# Heat capacity -> the conductance with which it makes the lag that is drawn.
_LAGS = {
    "air_J_K": "air_wall_W_K",
    "wall_J_K": "air_wall_W_K",
    "heater_J_K": "heater_air_W_K",
    "coil_J_K": "coil_wall_W_K",
    "granite_J_K": "granite_air_W_K",
    "body_J_K": "body_air_W_K",
}
_ALONE = ("heater_W", "compressor_W", "probe_lag_s", "near_lag_s")


def drawn(seed: int, spread: float = 0.3) -> ChamberSpec:
    """Another chamber of the kind: every conductance, every lag, the heater and the compressor drawn independently and
    evenly within +-`spread` of the standard one's. A heat capacity is its lag times its conductance."""
    draw = random.Random(f"chamber {seed}")
    standard = ChamberSpec()

    def factor() -> float:
        return draw.uniform(1.0 - spread, 1.0 + spread)

    factors = {name: factor() for name in (*_CONDUCTANCES, *_ALONE)}
    factors |= {capacity: factor() * factors[conductance] for capacity, conductance in _LAGS.items()}
    return replace(standard, **{name: getattr(standard, name) * value for name, value in factors.items()})
