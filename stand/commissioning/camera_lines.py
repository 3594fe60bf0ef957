"""Whether the line that several cameras share carries their frames."""

from __future__ import annotations

from dataclasses import asdict

from stand.commissioning.finding import Finding
from stand.config.stand_config import StandConfig
from stand.estimating.camera_lines import camera_lines

_ADVICE = "give it a lower frame_rate_hz, larger packets (packet_size, with jumbo frames), or a line of its own"


def shared_lines(config: StandConfig, name: str) -> tuple[Finding, ...]:
    """What a camera needs of its line, by the stand's file; nothing for one that has a line of its own."""
    findings: list[Finding] = []
    for line in camera_lines(config):
        if line.name != name or line.shared_by == 1:
            continue
        fits = line.frame_s <= 1 / config.cameras[line.name].frame_rate_hz
        text = str(line).removeprefix(f"{line.name}: ")
        advice = "" if fits else _ADVICE
        findings.append(Finding(line.name, "line", "ok" if fits else "failed", text, advice, asdict(line)))
    return tuple(findings)
