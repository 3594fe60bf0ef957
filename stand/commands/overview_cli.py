"""`stand overview`: all stands at a glance, and the sessions of all."""

from __future__ import annotations

from typing import Annotated

import typer

from thermostand.foundation.command_app import App
from thermostand.foundation.instants import format_local
from thermostand.foundation.output import show
from thermostand.stand.commands.endpoint import ConfigOption

app = App()


@app.command()
def overview(
    config: ConfigOption = "simulated",
    find: Annotated[
        str, typer.Option(help="Search the sessions of all: words of date, recipe, operator, number, tag.")
    ] = "",
) -> None:
    """Show every stand of this machine, and those of interface.stands of the stand's file: who needs somebody first.

    Example: stand overview --config my-stand.yaml
    """
    from thermostand.stand.config.stand_config import find_packaged, load_config
    from thermostand.stand.serving.overview import Overview, StandCard

    stands = Overview(load_config(find_packaged("", config)).interface.stands)

    def describe(card: StandCard) -> str:
        values = (("set-point", card.set_point_degC), ("air", card.air_degC), ("camera", card.camera_degC))
        end = "" if card.end_ns is None else f"ends {format_local(card.end_ns + card.utc_offset_ns)}"
        parts = [
            card.why,
            card.doing,
            *(f"{name} {value:.1f} degC" for name, value in values if value is not None),
            f"step {card.step} of {card.steps}" if card.steps else "",
            end,
        ]
        return f"{card.name}  {card.standing}" + "".join(f", {part}" for part in parts if part)

    try:
        if find:
            found = stands.find_sessions(find)
            show(
                [each.model_dump(mode="json") for each in found],
                [
                    f"{each.stand}  {each.name}  {each.run}  {each.frames} frames  {each.camera} {' '.join(each.tags)}"
                    for each in found
                ],
            )
            return
        cards = stands.cards()
        show([each.model_dump(mode="json") for each in cards], [describe(each) for each in cards])
    finally:
        stands.close()
