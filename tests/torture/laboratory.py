"""The simulated laboratory of a torture run: `python -m tests.torture.laboratory`, in the place of `drivers.sim`.

It breaks what the case says, in the case's own time, and writes down what truly happened in the program's N-th life:
the plant at each of its steps (truth-N.bin), the true centres in each image (centres-N.bin) and the bytes on each wire
(wire-N.jsonl). When the program is gone, time goes on for AFTER_S: what is on then shows.
"""

from __future__ import annotations

import json
import os
import re
import signal
import struct
import sys
from contextlib import suppress
from pathlib import Path

from tests.torture.case import Case, Fault, read_case
from thermostand.drivers.sim.control import serve_control
from thermostand.drivers.sim.laboratory import Laboratory, LaboratorySpec
from thermostand.drivers.sim.laboratory_faults import FaultSchedule, PlannedFault
from thermostand.drivers.sim.physics.optics import Optics, compute_true_centres_px
from thermostand.foundation.clock import to_ns
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.stop_signal import StopSignal

FOLDER, LIFE = "TORTURE_FOLDER", "TORTURE_LIFE"
AFTER_S = 90.0
MENDED_AT_LIFE = 6
TRUTH = (
    *("heater_enabled", "heater_on_fraction", "compressor_on", "flap_open", "cut_out_open", "camera_powered"),
    *("bulk_air_degC", "air_degC", "chamber_degC", "granite_inside_degC", "granite_outside_degC", "artifact_degC"),
    *("laboratory_degC", "body_degC", "sensor_degC"),
)
_NAMED = {"axis": "linear|rotary", "chamber": "chamber|regulator", "inputs": "inputs|door", "heater": "heat"}
"""What the program calls a device that has another name here."""
ROW, CENTRES = struct.Struct(f"<q{len(TRUTH)}d"), struct.Struct("<q108d")


class ObservedLaboratory(Laboratory):
    """As it is, and it takes notes."""

    def __init__(self, spec: LaboratorySpec, folder: Path, life: int) -> None:
        self._truth = (folder / f"truth-{life}.bin").open("wb")
        self._wires = (folder / f"wire-{life}.jsonl").open("w", buffering=1)
        super().__init__(spec)
        self.plant.on_step.append(self._note)  # after the regulator's and the relays'
        self._centres = (folder / f"centres-{life}.bin").open("wb")
        seen_by = self.plant.optics
        self.plant.optics = lambda time_ns, *kind: self._noted(time_ns, seen_by(time_ns, *kind))

    def after(self) -> None:
        """Time goes on without the program."""
        if self.is_virtual:
            self.advance(self.now_ns + to_ns(AFTER_S))

    def close(self) -> None:
        super().close()
        self._truth.close()
        self._centres.close()
        self._wires.close()

    def _note(self, time_ns: int, dt_s: float) -> None:
        plant = self.plant
        values = [plant.flap_open_at(time_ns) if name == "flap_open" else float(getattr(plant, name)) for name in TRUTH]
        self._truth.write(ROW.pack(time_ns, *values))

    def _noted(self, time_ns: int, optics: Optics) -> Optics:
        """What a camera sees, with where the target's centres truly are in its image."""
        self._centres.write(CENTRES.pack(time_ns, *compute_true_centres_px(optics).flat))
        return optics

    def listen(self, name, address, make_engine) -> None:
        super().listen(name, address, make_engine)
        faults = self._links[name].faults
        apply = faults.apply

        def heard(request: bytes, reply: bytes) -> list[bytes]:
            pieces = apply(request, reply)
            row = [self.now_ns, name, request.hex(), b"".join(pieces).hex()]
            with suppress(ValueError):  # closed
                self._wires.write(f"{json.dumps(row)}\n")
            return pieces

        faults.apply = heard


class Breaking(FaultSchedule):
    """Faults as planned; of those that this laboratory cannot have nothing comes."""

    def _set(self, name: str, value: object) -> None:
        with suppress(ConfigError):
            super()._set(name, value)


def list_planned_faults(case: Case, now_ns: int, folder: Path, life: int) -> list[PlannedFault]:
    """What is still to come of the case's faults, or stands, seen from now. An operator who has resumed in vain mends
    what he was reported, of what stood until then; in the end everything. In real time they are broken over the control
    socket."""
    if life >= MENDED_AT_LIFE or case.is_real:
        return []
    log = "".join((folder / f"output-{number}.txt").read_text() for number in range(1, life))
    path = folder / f"truth-{life - 1}.bin"
    before = path.read_bytes()[-ROW.size :] if path.exists() else b""
    until_ns = max(now_ns, ROW.unpack(before)[0] if before else 0)
    now_s, until_s = ((time_ns - case.start_ns) / 1e9 for time_ns in (now_ns, until_ns))
    left = [fault for fault in case.faults if fault.at_s + fault.for_s > now_s]
    return [
        PlannedFault(each.name, each.value, max(0.0, each.at_s - now_s), each.for_s - max(0.0, now_s - each.at_s))
        for each in left
        if each.at_s > until_s or not is_named(each, log)
    ]


def is_named(fault: Fault, log: str) -> bool:
    """Whether these words name the fault's device."""
    device = fault.name.partition(".")[0]
    return re.search(rf"\b(?:{_NAMED.get(device, device)})", log) is not None


def main() -> int:
    ending, parent = StopSignal((signal.SIGTERM, signal.SIGINT)), os.getppid()
    folder = Path(os.environ[FOLDER])
    spec = parse_document(sys.stdin.read(), LaboratorySpec, "laboratory")
    life, case = int(os.environ[LIFE]), read_case(folder / "case.yaml")
    (begun := folder / f"begun-{life}").write_text(str(os.getpid()))
    laboratory = ObservedLaboratory(spec, folder, life)
    schedule = Breaking(laboratory, list_planned_faults(case, laboratory.now_ns, folder, life))
    control = serve_control(laboratory, schedule, ending.ask)
    print(json.dumps({**laboratory.addresses, "control": control.address}), flush=True)  # noqa: T201 - as drivers.sim
    while not ending.wait(0.1) and os.getppid() == parent:
        schedule.tick()
    laboratory.after()
    laboratory.close()
    control.close()
    begun.unlink()  # all is written
    return 0


if __name__ == "__main__":
    sys.exit(main())
