"""A simulated laboratory in which time stands still: its temperatures are what a test sets."""

from __future__ import annotations

from thermostand.drivers.sim.physics.plant import Plant, PlantSpec


class StillPlant(Plant):
    def __init__(self, now_ns: int, **temperatures_degC: float) -> None:
        """With a powered camera, and these temperatures by their names without the unit."""
        super().__init__(PlantSpec(camera_powered=True), now_ns)
        for name, value in temperatures_degC.items():
            setattr(self, f"{name}_degC", value)

    def advance(self, now_ns: int) -> None:
        self.advanced_ns = now_ns

    def switch_camera(self, now_ns: int, *, on: bool) -> None:
        with self.lock:
            self.now_ns, self.camera_powered = now_ns, on
