"""The documents of a stand that a user edits; `stand config schema` writes their JSON Schemas."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import BaseModel

from drivers.wires.registers import RegisterMap
from markers.target import Target
from stand.config.recipe import Recipe
from stand.config.stand_config import StandConfig

DOCUMENTS: Mapping[str, type[BaseModel]] = {
    "stand": StandConfig,
    "recipe": Recipe,
    "registers": RegisterMap,
    "target": Target,
}
