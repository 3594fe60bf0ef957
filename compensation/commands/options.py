"""What the commands of `compensate` share: options, and the target they are given."""

from __future__ import annotations

import importlib.resources
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from foundation.errors import ConfigError
from foundation.output import say
from markers.target import Target, load_target

TargetOption = Annotated[
    str | None, typer.Option("--target", help="A target file or an installed name; else the session's own.")
]
CameraName = Annotated[
    str | None, typer.Option("--camera", help="Of sessions of several cameras, by its name in the stand's file.")
]
DetailsOption = Annotated[
    Path | None,
    typer.Option(help="A file that states what no recording knows: lens, certificates, places of sensors, u_air_K."),
]
AcrossGap = Annotated[
    bool,
    typer.Option(
        "--across-gap",
        help="Use frames from before and after a gap together, though camera minus air has changed in it.",
    ),
]
Incomplete = Annotated[bool, typer.Option("--incomplete", help="Use a session although part of it is missing.")]
Workers = Annotated[int, typer.Option("--workers", help="Processes that look for markers, side by side.")]
Cluster = Annotated[
    str | None, typer.Option("--cluster", help="A Dask scheduler, host:port, whose workers see the same files.")
]
Cache = Annotated[bool, typer.Option("--cache/--no-cache", help="Keep the markers found, and reuse those kept.")]


def installed_target(name: str) -> Target:
    """The target of a file, or of an installed name; ConfigError that lists what there is."""
    if Path(name).is_file():
        return load_target(Path(name))
    folder = Path(str(importlib.resources.files("configs"))) / "targets"
    known = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
    if name.removesuffix(".yaml") not in known:
        raise ConfigError(f"{name}: no such file, and not one of the installed targets: {', '.join(known)}")
    return load_target(known[name.removesuffix(".yaml")])


def named_target(name: str | None) -> Target | None:
    """The target of an option, None when it was not given."""
    return None if name is None else installed_target(name)


def said_if(incomplete: bool) -> Callable[[str], None] | None:
    """For `open_whole`: what is missing of a session is a warning with --incomplete, and else refused."""
    return (lambda text: say(f"warning: {text}")) if incomplete else None
