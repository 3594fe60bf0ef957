"""What to run: the one place where configuration, recipe and target are found, read and checked together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from thermostand.drivers.wires.bus import Bus
from thermostand.experiments.recipe_steps import RecipeStep, find_faults
from thermostand.experiments.steps import PlannedStep
from thermostand.foundation.clock import WallClock
from thermostand.foundation.documents import parse_document, read_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.hub import Hub
from thermostand.markers.target import Target
from thermostand.stand.assembly.assemble import make_devices
from thermostand.stand.config.check_record import ATTACHMENT, load_check_record
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.estimating.durations import ConfiguredStand
from thermostand.stand.estimating.estimate import check_step, price_plan

# A session has its register maps and simulated cameras with it, so that it can be resumed elsewhere.
_REGISTERS, _OPTICS = "registers-{}.yaml", "optics-{}.yaml"  # their names in a session


@dataclass(frozen=True, slots=True)
class Order:
    """What to run: the checked files and their texts (they are attached to the recording). attended: somebody is there
    to do what the plan prompts for. at_configured_addresses: the laboratory of a virtual run answers there instead of
    at free addresses, for a program that has to find it. register_texts: the register maps, by names of attachments.
    commissioning_text: the record of `stand check`, "" without one."""

    config: StandConfig
    recipe: Recipe
    config_text: str
    recipe_text: str
    target_text: str
    attended: bool = False
    at_configured_addresses: bool = False
    register_texts: Mapping[str, str] = field(default_factory=dict[str, str])
    optics_texts: Mapping[str, str] = field(default_factory=dict[str, str])
    commissioning_text: str = ""

    def attachments(self) -> dict[str, str]:
        """The texts by the names under which a session has them."""
        texts = {"config.yaml": self.config_text, "recipe.yaml": self.recipe_text, "target.yaml": self.target_text}
        record = {ATTACHMENT: self.commissioning_text} if self.commissioning_text else {}
        return texts | dict(self.register_texts) | dict(self.optics_texts) | record


def load_order(recipe: str, config: str) -> Order:
    """The files (or installed names), read and checked as far as can be without the stand: ConfigError
    names what is wrong in which of them."""
    paths = {"config.yaml": find_packaged("", config), "recipe.yaml": find_packaged("recipes", recipe)}
    stand = load_config(paths["config.yaml"])
    record = load_check_record(paths["config.yaml"])
    paths["target.yaml"] = find_packaged("targets", stand.target, paths["config.yaml"], "target")
    texts = {name: read_document(path) for name, path in paths.items()}
    order = parse_order(texts, {name: str(path) for name, path in paths.items()})
    try:
        order = load_register_maps(
            replace(
                order,
                config=stand,
                optics_texts=read_optics_texts(stand),
                commissioning_text="" if record is None else record.text,
            )
        )
    except ConfigError as error:
        raise ConfigError(f"{paths['config.yaml']}: {error}") from error
    try:
        price_plan(order.recipe.plan(), order.config)
    except ConfigError as error:
        raise ConfigError(f"{paths['recipe.yaml']}: {error}") from error
    return order


def load_register_maps(order: Order) -> Order:
    """The order with the register maps as they are now; ConfigError when one is wrong, or that of another kind of
    unit."""
    texts = read_register_texts(order.config)
    clock = WallClock()
    bus = Bus("bus", order.config.bus, clock)
    make_devices(order.config, bus, Hub(), clock)
    return replace(order, register_texts=texts)


def read_register_texts(config: StandConfig) -> dict[str, str]:
    """The register maps of a stand as they are now, by names of attachments; ConfigError when one is missing."""
    return {
        _REGISTERS.format(name): read_document(find_packaged("registers", unit.registers, key=f"{name}.registers"))
        for name, unit in config.units.items()
    }


def read_optics_texts(config: StandConfig) -> dict[str, str]:
    """The optics' files of a stand's simulated cameras as they are now, by names of attachments that end in the
    camera's; none of built-in optics. ConfigError when one is missing."""
    simulated = {} if config.simulation is None else config.simulation.cameras
    return {
        _OPTICS.format(name): read_document(find_packaged("optics", str(camera.optics), key=f"optics of {name}"))
        for name, camera in simulated.items()
        if camera.is_preset
    }


def select_optics(config: StandConfig, texts: Mapping[str, str]) -> dict[str, str]:
    """Select those that are among the attachments of a session; built-in optics have none."""
    simulated = () if config.simulation is None else config.simulation.cameras
    return {name: texts[name] for name in map(_OPTICS.format, simulated) if name in texts}


def check_plan(plan: Iterable[PlannedStep], config: StandConfig) -> None:
    """ConfigError when a step cannot be where it is, or is nothing for this stand."""
    planned = tuple(plan)
    for _, text in find_plan_faults(planned, config):
        raise ConfigError(text)
    price_plan(planned, config)


def find_plan_faults(plan: Sequence[PlannedStep], config: StandConfig) -> Iterator[tuple[int, str]]:
    """(index, sentence) of each step that cannot be where it is, or is nothing for this stand."""
    written, stand = (RecipeStep((each.index,), each.step) for each in plan), ConfiguredStand(config)
    for each, (_, fault) in zip(plan, find_faults(written), strict=True):
        if fault:
            yield each.index, f"step {each.index + 1}: {fault}"
            continue
        try:
            check_step(each, stand)
        except ConfigError as error:
            yield each.index, str(error)


def parse_order(texts: Mapping[str, str], names: Mapping[str, str]) -> Order:
    """The order of these texts, by the names under which a session has them (Order.attachments); `names` are for
    messages. ConfigError when this version of the program refuses one of them."""
    config = parse_document(texts["config.yaml"], StandConfig, names["config.yaml"])
    order = Order(
        config,
        parse_document(texts["recipe.yaml"], Recipe, names["recipe.yaml"]),
        texts["config.yaml"],
        texts["recipe.yaml"],
        texts["target.yaml"],
        register_texts={name: texts[name] for name in map(_REGISTERS.format, config.units) if name in texts},
        optics_texts=select_optics(config, texts),
        commissioning_text=texts.get(ATTACHMENT, ""),
    )
    parse_document(order.target_text, Target, names["target.yaml"])
    return order
