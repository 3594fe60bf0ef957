"""Whether the line that several cameras share carries their frames."""

from __future__ import annotations

import socket
from dataclasses import asdict

from thermostand.stand.commissioning.finding import Finding
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.camera_lines import camera_lines

_IP_MTU = 14  # linux/in.h
_GVCP = 3956
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


def packet_finding(name: str, address: str, packet_size: int) -> Finding:
    """Whether the network interface towards the camera takes its packets whole: larger ones are lost, or come in
    pieces that the camera does not send again."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as towards:
        try:
            towards.connect((address, _GVCP))
            mtu = towards.getsockopt(socket.IPPROTO_IP, _IP_MTU)
        except OSError as error:
            text = f"packets of {packet_size} bytes; the line's own limit is not known ({error.strerror})"
            return Finding(name, "packets", "unverified", text, "look at the MTU of its network interface")
    data: dict[str, object] = {"packet_size": packet_size, "mtu": mtu}
    text = f"packets of {packet_size} bytes, the network interface takes up to {mtu}"
    if packet_size > mtu:
        to_do = f"`ip link set INTERFACE mtu 9000`, on a switch, too; or packet_size: {min(mtu, 1500)}"
        return Finding(name, "packets", "failed", text, to_do, data)
    return Finding(name, "packets", "ok", text, data=data)
