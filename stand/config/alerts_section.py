"""The configuration's alerts section, and the file of secrets that it names."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, get_args

from pydantic import Field

from thermostand.foundation.documents import Document
from thermostand.foundation.events import AlertCause
from thermostand.foundation.private_file import load_private_document


class AlertsConfig(Document):
    """Who gets a message when nobody is at the stand. secrets: a YAML file (mode 0600) with `urls`, addresses of
    Apprise (https://github.com/caronc/apprise), and `alive_url`; it is never recorded or shown. causes: what is
    sent there. command: a program that gets each message as its last argument, without a shell; command_limit_s: real
    seconds it may take; command_causes: what it gets, for a siren wants fewer messages than a person.
    grace_s: what is over by itself within this is not reported. most_per_h: messages, but for trips.
    alive_every_s: how often alive_url is called while all is well; a service that misses the call raises the alarm when
    this computer cannot.
    """

    secrets: Path | None = None
    causes: tuple[AlertCause, ...] = get_args(AlertCause)
    command: tuple[Annotated[str, Field(min_length=1)], ...] = Field(default=(), max_length=100)
    command_limit_s: float = Field(default=10.0, gt=0, le=60)
    command_causes: tuple[AlertCause, ...] = ("trip", "hold", "run_aborted")
    grace_s: float = Field(default=60.0, ge=0, le=3600)
    most_per_h: int = Field(default=20, ge=1, le=1000)
    alive_every_s: float = Field(default=300.0, ge=1, le=86400)


class AlertSecrets(Document):
    """The file that alerts.secrets names."""

    urls: tuple[str, ...] = Field(default=(), max_length=50)
    alive_url: str = Field(default="", pattern=r"^(https?://\S+)?$")


def load_secrets(path: Path) -> AlertSecrets:
    """ConfigError as load_private_document."""
    form = "`urls:` with a list of Apprise's addresses, and `alive_url:` with an http address"
    return load_private_document(path, "alerts.secrets", AlertSecrets, form)
