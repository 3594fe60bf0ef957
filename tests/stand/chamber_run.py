"""A simulated chamber without wires: the plant, its regulator and the compressor's logic, as readings on a hub."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.units.regulator import FakeRegulator
from thermostand.foundation.clock import NS_PER_S, FollowedClock, to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Reading
from thermostand.stand.chamber.compressor import CompressorState, decide
from thermostand.stand.config.stand_config import CompressorConfig

START_NS = 1_767_290_400 * NS_PER_S
POLL_S = 5.0
COMPRESSOR = CompressorConfig()
OPEN_BEFORE_END_S = 60.0  # the flap, at the end of every dwell


@dataclass
class ChamberRun:
    """Set-points, degC, each held for a dwell. `disturb` may break something before each poll, `compressor` may wear
    the chamber by running against the heat."""

    set_points_degC: Iterable[float]
    soak_s: float
    laboratory_degC: float = 24.0
    disturb: Callable[["ChamberRun", float], None] = lambda run, time_s: None
    compressor_always: bool = False
    hub: Hub = field(default_factory=Hub)

    def __post_init__(self) -> None:
        self.clock = FollowedClock(START_NS)
        self.plant = Plant(PlantSpec(laboratory_degC=self.laboratory_degC, camera_powered=True), START_NS)
        self.regulator = FakeRegulator(self.plant, self.clock, 1)
        self.permitted = True
        self.flap_open = 0.0
        self.plant.flap_open_at = lambda time_ns: self.flap_open
        self._compressor = CompressorState(False, START_NS)
        self.send("0600000001")  # writing on
        self.send("0600000401")  # RAM mode

    def send(self, pdu: str) -> None:
        self.regulator.handle(bytes.fromhex(pdu))

    def stop(self) -> None:
        """As the stand stops its chamber: regulator, permit and compressor."""
        self.send("0600000101")
        self.permitted = self._running = False
        self._compressor = CompressorState(False, self.clock.now_ns())

    def polls(self) -> Iterator[int]:
        """Every instant at which all was read, ns."""
        self.send("0600000100")
        self._running = True
        end_ns = START_NS
        for set_point_degC in self.set_points_degC:
            self.send(f"062103{round(set_point_degC * 10) & 0xFFFF:04x}")
            end_ns += to_ns(self.soak_s)
            while (now_ns := self.clock.now_ns()) < end_ns:
                self.disturb(self, (now_ns - START_NS) / NS_PER_S)
                self.flap_open = float(end_ns - now_ns <= to_ns(OPEN_BEFORE_END_S))
                self._advance(now_ns + to_ns(POLL_S))
                yield self.clock.now_ns()

    def _advance(self, now_ns: int) -> None:
        self.plant.heater_enabled = self.permitted
        self.clock.follow(now_ns)
        self.plant.advance(now_ns)
        self._publish(now_ns)
        mv_heat, mv_cool = (self._latest(f"regulator.mv_{side}") for side in ("heat", "cool"))
        if self._running:
            self._compressor = decide(self._compressor, COMPRESSOR, mv_heat, mv_cool, now_ns)
        self.plant.compressor_on = self._compressor.running or self.compressor_always

    def _latest(self, channel: str) -> float:
        reading = self.hub.latest(channel)
        assert reading is not None
        return reading.value

    def _publish(self, now_ns: int) -> None:
        def words(address: int, count: int) -> list[float]:
            reply = self.regulator.handle(bytes([3, *address.to_bytes(2, "big"), 0, count]))
            assert reply is not None
            return [int.from_bytes(reply[at : at + 2], "big", signed=True) / 10 for at in range(2, 2 + 2 * count, 2)]

        pv, _, _, _, mv_heat, mv_cool = words(0x2000, 6)
        plant = self.plant
        values = {
            "regulator.pv": pv,
            "regulator.sp": words(0x2103, 1)[0],
            "regulator.mv_heat": mv_heat,
            "regulator.mv_cool": mv_cool,
            "regulator.running": float(self._running),
            "relays.heater_enable": float(self.permitted),
            "relays.compressor": float(plant.compressor_on),
            "flap.position": self.flap_open,
            "thermometers.air": plant.air_degC,
            "thermometers.granite_inside": plant.granite_inside_degC,
            "thermometers.laboratory": plant.laboratory_degC,
        }
        readings = tuple(Reading(channel, value, "1", now_ns) for channel, value in values.items())
        self.hub.publish(Batch("chamber", now_ns, readings))
