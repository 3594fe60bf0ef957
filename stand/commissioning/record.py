"""The commissioning record: what `stand check` found, as JSON and HTML next to the stand's file."""

from __future__ import annotations

import importlib.metadata
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache
from itertools import groupby
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from thermostand.drivers.devices.device_check import Finding, Verdict, find_worst
from thermostand.drivers.settings import Identity
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.files import write_atomically
from thermostand.stand.config.check_record import compute_digest, get_record_files
from thermostand.stand.config.stand_config import StandConfig

SCHEMA = "stand-check/1"


@dataclass(frozen=True, slots=True)
class CommissioningRecord:
    """One check. texts: the stand's file and its register maps, by the names under which sessions have them."""

    config: StandConfig
    file: str
    texts: Mapping[str, str]
    began_ns: int
    ended_ns: int
    has_moves: bool
    findings: Sequence[Finding]
    identities: Mapping[str, Identity]

    def data(self) -> dict[str, object]:
        """The whole record; instants are UTC."""
        return {
            "schema": SCHEMA,
            "stand": self.config.name,
            "config": self.file,
            "digests": {name: compute_digest(text) for name, text in self.texts.items()},
            "began": _format_utc(self.began_ns),
            "ended": _format_utc(self.ended_ns),
            "moves": self.has_moves,
            "simulated": self.config.simulation is not None,
            "operator": self.config.operator,
            "host": platform.node(),
            "software_version": importlib.metadata.version("thermostand"),
            "verdict": find_worst(self.findings),
            "identities": {name: asdict(identity) for name, identity in self.identities.items()},
            "lenses": {name: camera.lens for name, camera in self.config.cameras.items() if camera.lens},
            "findings": [asdict(finding) for finding in self.findings],
        }

    def html(self) -> str:
        """The same, to be read and printed."""
        counts: dict[Verdict, int] = {"failed": 0, "warning": 0, "unverified": 0, "ok": 0}
        for finding in self.findings:
            counts[finding.verdict] += 1
        groups = [(name, tuple(found)) for name, found in groupby(self.findings, lambda finding: finding.device)]
        return _load_template().render(
            record=self,
            counts=counts,
            groups=[(name, find_worst(found), found) for name, found in groups],
            began=_format_utc(self.began_ns).replace("T", " ").removesuffix("+00:00"),
            took_s=(self.ended_ns - self.began_ns) / NS_PER_S,
            host=platform.node(),
            version=importlib.metadata.version("thermostand"),
            digests={name: compute_digest(text)[:16] for name, text in self.texts.items()},
        )

    def write(self, config: Path) -> tuple[Path, Path]:
        """Replace the record next to the stand's file `config`; return its files. SessionError when refused."""
        data, page = get_record_files(config)
        write_atomically(page, self.html())
        write_atomically(data, json.dumps(self.data(), indent=2, ensure_ascii=False) + "\n")
        return data, page


def _format_utc(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns // NS_PER_S, UTC).isoformat()


@cache
def _load_template() -> Template:
    loader = PackageLoader("stand", "commissioning")
    made = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return made.get_template("record.html.jinja")
