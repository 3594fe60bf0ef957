"""A session of a drawn chamber without wires: plant, regulator, thermometers and compressor, polled as by a daemon.

What comes out are the readings of each poll, as over the bus: the regulator's display of 0.1 K, the module's words
and noise, the camera's steps of 0.25 K. The guard's rules look at them; when one trips, heat and cold are cut.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.units.regulator import FakeRegulator
from thermostand.drivers.sim.units.thermometers import FakeThermometers
from thermostand.foundation.clock import NS_PER_S, FollowedClock, to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.stand.chamber.compressor import CompressorState, decide
from thermostand.stand.config.stand_config import CompressorConfig

START_NS = 1_767_290_400 * NS_PER_S
POLL_S, SLOW_POLL_S = 5.0, 10.0
CHANNELS = {"granite_inside": 0, "granite_outside": 1, "artifact": 2, "air": 3, "laboratory": 4}
AIR, GRANITE = CHANNELS["air"], CHANNELS["granite_inside"]
CAMERA_STEP_K = 0.25
COMPRESSOR = CompressorConfig()


@dataclass
class Chamber:
    """One drawn chamber with its regulator. `poll` moves it on by POLL_S and publishes what the daemon would read.

    chamber_seed: which chamber is drawn, None for the standard one. channels: its thermometers and where they end.
    """

    chamber_seed: int | None
    laboratory_degC: float = 24.0
    camera_powered: bool = True
    hub: Hub = field(default_factory=Hub)
    channels: Mapping[str, int] = field(default_factory=lambda: CHANNELS)

    def __post_init__(self) -> None:
        self.clock = FollowedClock(START_NS)
        spec = PlantSpec(
            chamber_seed=self.chamber_seed, laboratory_degC=self.laboratory_degC, camera_powered=self.camera_powered
        )
        self.plant = Plant(spec, START_NS)
        self.regulator = FakeRegulator(self.plant, self.clock, 1)
        self.thermometers = FakeThermometers(
            self.plant, self.clock, 3, dict(self.channels), seed=self.chamber_seed or 0
        )
        self.permitted = self.running = False
        self.flap_open = 0.0
        self.plant.flap_open_at = lambda time_ns: self.flap_open
        self.hottest_degC = -300.0  # of the air's bulk
        self._compressor = CompressorState(False, START_NS - to_ns(3600))
        self.plant.on_step.append(self._watch)
        self._send("0600000001")  # writing on
        self._send("0600000401")  # RAM mode

    @property
    def time_s(self) -> float:
        """Since the begin."""
        return (self.clock.now_ns() - START_NS) / NS_PER_S

    def start(self, set_point_degC: float) -> None:
        """As the stand starts its chamber."""
        self.set_temperature(set_point_degC)
        self._send("0600000100")
        self.permitted = self.running = True

    def set_temperature(self, set_point_degC: float) -> None:
        """A new set-point."""
        self._send(f"062103{round(set_point_degC * 10) & 0xFFFF:04x}")

    def stop(self) -> None:
        """As the stand is made safe: regulator stopped, permits and compressor off, flap shut."""
        self._send("0600000101")
        self.permitted = self.running = False
        self.flap_open = 0.0
        if self._compressor.running:
            self._compressor = CompressorState(False, self.clock.now_ns(), self._compressor.starts_ns)

    def poll(self) -> int:
        """POLL_S later, everything due read; the instant, ns."""
        plant = self.plant
        plant.heater_enabled, plant.compressor_on = self.permitted, self._compressor.running
        now_ns = self.clock.now_ns() + to_ns(POLL_S)
        self.clock.follow(now_ns)
        plant.advance(now_ns)
        for device, readings in self._read(now_ns):
            self.hub.publish(Batch(device, now_ns, readings))
        if self.running:
            heat, cool = (self.hub.latest(f"regulator.mv_{side}") for side in ("heat", "cool"))
            if heat is not None and cool is not None:
                self._compressor = decide(self._compressor, COMPRESSOR, heat.value, cool.value, now_ns)
        return now_ns

    def _watch(self, time_ns: int, dt_s: float) -> None:
        self.hottest_degC = max(self.hottest_degC, self.plant.bulk_air_degC)

    def _send(self, pdu: str) -> None:
        self.regulator.handle(bytes.fromhex(pdu))

    def _read(self, now_ns: int) -> Iterator[tuple[str, tuple[Reading, ...]]]:
        def readings(device: str, values: dict[str, float]) -> tuple[str, tuple[Reading, ...]]:
            return device, tuple(Reading(f"{device}.{name}", value, "1", now_ns) for name, value in values.items())

        pv, _, sp, _, heat, cool = self._words(bytes.fromhex("0320000006"))
        regulator = {"pv": pv, "sp": sp, "mv_heat": heat, "mv_cool": cool}
        yield readings("regulator", {**regulator, "running": float(self.running), "fault": 0.0})
        yield "thermometers", tuple(self._temperatures(now_ns))
        if self.plant.camera_powered:
            shown = round(self.plant.sensor_degC / CAMERA_STEP_K) * CAMERA_STEP_K
            yield readings("camera", {"temperature": shown})
        else:
            yield "camera", (bad_reading("camera.temperature", "degC", now_ns, "the camera is off"),)
        if (now_ns - START_NS) % to_ns(SLOW_POLL_S) == 0:
            relays = {"heater_enable": self.permitted, "compressor": self._compressor.running}
            relays["camera_power"] = self.plant.camera_powered
            yield readings("relays", {name: float(on) for name, on in relays.items()})
            yield readings("flap", {"position": self.flap_open})

    def _words(self, pdu: bytes) -> list[float]:
        reply = self.regulator.handle(pdu)
        assert reply is not None
        return [int.from_bytes(reply[at : at + 2], "big", signed=True) / 10 for at in range(2, len(reply), 2)]

    def _temperatures(self, now_ns: int) -> Iterator[Reading]:
        reply = self.thermometers.handle(bytes.fromhex("0400000006"))
        assert reply is not None
        for name, number in self.channels.items():
            word = int.from_bytes(reply[2 + 2 * number : 4 + 2 * number], "big", signed=True)
            channel = f"thermometers.{name}"
            if word in (0x7FFF, -0x8000):
                yield bad_reading(channel, "degC", now_ns, "open wire or short")
            else:
                yield Reading(channel, word * 100.0 / 0x7FFF, "degC", now_ns)


Action = Callable[[Chamber], None]


def iterate_timed(chamber: Chamber, actions: Iterable[tuple[float, Action]]) -> Iterator[int]:
    """Every poll's instant while each action is done in turn and the time after it, s, goes by."""
    due_s = chamber.time_s
    for after_s, action in actions:
        action(chamber)
        due_s += after_s
        while chamber.time_s < due_s:
            yield chamber.poll()
