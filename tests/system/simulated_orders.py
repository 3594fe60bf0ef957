"""Orders for a simulated stand at addresses of its own, to be run by a process of its own."""

from __future__ import annotations

from pathlib import Path

import yaml

from tests.addresses import allocate_camera_address, find_free_port
from thermostand.foundation.documents import load_document
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.running.order import Order


def simulated_order(directory: Path, recipe: str, poll_s: float | None = None) -> Order:
    """The recipe on the installed simulated stand; every device is polled each `poll_s`, None for as configured."""
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["bus"]["address"] = f"tcp:127.0.0.1:{find_free_port()}"
    for name, axis in data["axes"].items():
        axis["address"] = f"serial:{directory / name}"
    data["flap"]["backend_address"] = f"tcp:127.0.0.1:{find_free_port()}"
    data["cameras"]["camera"]["address"] = allocate_camera_address()
    data["simulation"]["control"] = f"tcp:127.0.0.1:{find_free_port()}"
    if poll_s is not None:
        sections = [data[name] for name in ("regulator", "thermometer_module", "relays", "flap")]
        for section in [*sections, *data["cameras"].values(), *data["axes"].values()]:
            section["poll_s"] = poll_s
    config_file, recipe_file = directory / "config.yaml", directory / "recipe.yaml"
    config_file.write_text(yaml.safe_dump(data))
    recipe_file.write_text(recipe)
    target = find_packaged("targets", "paper-9x6").read_text()
    return Order(load_config(config_file), load_document(recipe_file, Recipe), config_file.read_text(), recipe, target)
