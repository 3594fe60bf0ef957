"""The configuration's alerts section, and the file of secrets that it names."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Literal

from pydantic import Field

from foundation.documents import Document, parse_document
from foundation.errors import ConfigError

Cause = Literal[
    "trip",
    "hold",
    "device_lost",
    "disk",
    "prompt",
    "run_started",
    "run_finished",
    "run_aborted",
    "queue_empty",
    "eta_slipped",
]
_ALL: tuple[Cause, ...] = (
    "trip",
    "hold",
    "device_lost",
    "disk",
    "prompt",
    "run_started",
    "run_finished",
    "run_aborted",
    "queue_empty",
    "eta_slipped",
)
_LARGEST_BYTES = 100_000


class AlertsConfig(Document):
    """Who is told when nobody is at the stand. secrets: a YAML file (mode 0600) with `urls`, addresses of Apprise
    (https://github.com/caronc/apprise), and `alive_url`; it is never recorded or shown. causes: what is told. grace_s:
    what is over by itself within this is not told. most_per_h: messages, but for trips. alive_every_s: how often
    alive_url is called while all is well; a service that misses the call raises the alarm when this computer cannot.
    """

    secrets: Path | None = None
    causes: tuple[Cause, ...] = _ALL
    grace_s: float = Field(default=60.0, ge=0, le=3600)
    most_per_h: int = Field(default=20, ge=1, le=1000)
    alive_every_s: float = Field(default=300.0, ge=1, le=86400)


class AlertSecrets(Document):
    """The file that alerts.secrets names."""

    urls: tuple[str, ...] = Field(default=(), max_length=50)
    alive_url: str = Field(default="", pattern=r"^(https?://\S+)?$")


def load_secrets(path: Path) -> AlertSecrets:
    """ConfigError when the file cannot be used, or others may read it; its sentence quotes nothing of the file."""
    place = f"alerts.secrets: {path}"
    try:
        fd = os.open(path.expanduser(), os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError as error:
        raise ConfigError(f"{place}: cannot be read ({error.strerror})") from error
    try:
        told = os.fstat(fd)
        if not stat.S_ISREG(told.st_mode) or told.st_size > _LARGEST_BYTES:
            raise ConfigError(f"{place}: is no file of a few lines")
        if told.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            mode = stat.S_IMODE(told.st_mode)
            raise ConfigError(f"{place}: others may read or write it (mode {mode:04o}); type `chmod 600 {path}`")
        data = os.read(fd, _LARGEST_BYTES)
    finally:
        os.close(fd)
    try:
        return parse_document(data.decode(), AlertSecrets, str(path))
    except (ConfigError, UnicodeDecodeError):
        text = (
            "is not as it should be: `urls:` with a list of Apprise's addresses, and `alive_url:` with an http address"
        )
        raise ConfigError(f"{place}: {text}") from None  # the reason would quote a secret
