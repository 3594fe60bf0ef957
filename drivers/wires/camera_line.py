"""How several cameras share one Ethernet line: pauses between packets, and whether the line carries them all."""

from __future__ import annotations

from thermostand.foundation.clock import NS_PER_S

# IEEE 802.3 around each IP packet: preamble 8, header 14, check sequence 4 and gap 12 bytes.
ETHERNET_BYTES = 38
GVSP_BYTES = 28 + 8  # IP, UDP and GVSP header within a packet (GigE Vision 1.2, section 21)
# One packet of each other camera and a tenth, so that no switch has to store more than a few.
_MARGIN = 1.1  # packets of the control channel, and senders that are not quite even


def compute_packet_wire_ns(packet_size: int, line_Mbps: float) -> float:
    """Return how long an IP packet of so many bytes takes on the line."""
    return (packet_size + ETHERNET_BYTES) * 8 / line_Mbps * 1e3


def compute_packet_delay_ns(packet_size: int, line_Mbps: float, shared_by: int) -> int:
    """The pause between two packets in which one packet of each other camera fits; 0 for a camera alone."""
    return round((shared_by - 1) * compute_packet_wire_ns(packet_size, line_Mbps) * _MARGIN)


def compute_frame_wire_s(frame_bytes: int, packet_size: int, line_Mbps: float, delay_ns: int = 0) -> float:
    """Return how long a frame takes to arrive: its packets, leader and trailer, with the pauses."""
    packets = -(-frame_bytes // (packet_size - GVSP_BYTES)) + 2
    return packets * (compute_packet_wire_ns(packet_size, line_Mbps) + delay_ns) / NS_PER_S
