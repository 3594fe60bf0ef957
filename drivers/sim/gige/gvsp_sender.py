"""Sends the packets of a camera: paced, lossy on demand, and once more when asked."""

from __future__ import annotations

import random
import socket
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

from thermostand.drivers.sim.gige import gvsp
from thermostand.drivers.sim.gige.gvcp import Resend
from thermostand.drivers.sim.gige.gvsp import ImageBlock

Destination = tuple[str, int]

KEPT_BLOCKS = 4
_BURST_bytes = 32_768  # sent without a pause: well below the smallest receive buffer in use (212,992 bytes)
_CATCH_UP_s = 0.002  # a stalled sender makes up for no more than this, or it would flood the receiver


# The switch between several cameras and the computer: one line out, a buffer in front of it, and what does not fit is
# lost, as in a real one.


BUFFER_bytes = 256_000  # a small one's, for all its ports
_OVERHEAD_bytes = 66  # Ethernet with preamble and gap, IP, UDP


class Switch:
    """rate_MBps: of the line out, 1e6 bytes/s. lost: packets for which a buffer was full."""

    def __init__(self, rate_MBps: float, buffer_bytes: int = BUFFER_bytes) -> None:
        self.lost = 0
        self._rate_Bps = rate_MBps * 1e6
        self._buffer_bytes = buffer_bytes
        self._held_bytes = 0.0
        self._at_s = 0.0
        self._lock = threading.Lock()  # each camera sends in a thread of its own

    def passes(self, size_bytes: int, now_s: float | None = None) -> bool:
        """Return whether a packet of so many bytes of payload, which comes now, gets through."""
        with self._lock:
            now_s = time.monotonic() if now_s is None else now_s
            left_bytes = self._held_bytes - (now_s - self._at_s) * self._rate_Bps
            self._held_bytes, self._at_s = max(0.0, left_bytes), now_s
            if self._held_bytes + size_bytes > self._buffer_bytes:
                self.lost += 1
                return False
            self._held_bytes += size_bytes + _OVERHEAD_bytes
            return True


@dataclass
class CameraFaults:
    """What goes wrong on a camera; change at any time.

    loss: probability 0..1 that a packet is lost, with the `burst` - 1 packets after it; seeded, so that a run repeats.
    truncated, doubled, reordered: probabilities that a packet arrives without its second half, twice, or after the one
    behind it. no_resend: capability bit off and requests ignored (the bit is read by clients at connect). silent_gvcp:
    the camera neither hears nor answers. silent_gvsp: no stream packet leaves. unpaced: packets leave as fast as they
    can. leader_early_s: the leader is so long ahead of the payload; stretch_s: which takes so long. drop_leader,
    drop_trailer: missing from every frame until asked for again. trigger_twice: every software
    trigger gives two frames. no_stream_channel: it says that it has none, as one that is not ready yet. temperature:
    DeviceTemperature reads 0, is refused, keeps its last value, or is no number; temperature_offset_K: it is wrong by
    so much. heartbeat_most_ms: the longest heartbeat time-out that it takes. payload_short_bytes: PayloadSize is too
    small by so much from the next change of region on.
    switch: what it shares with other cameras on the way to the computer.
    """

    seed: int = 0
    loss: float = 0.0
    burst: int = 1
    truncated: float = 0.0
    doubled: float = 0.0
    reordered: float = 0.0
    no_resend: bool = False
    silent_gvcp: bool = False
    silent_gvsp: bool = False
    unpaced: bool = False
    leader_early_s: float = 0.0
    stretch_s: float = 0.0
    drop_leader: bool = False
    drop_trailer: bool = False
    trigger_twice: bool = False
    no_stream_channel: bool = False
    temperature: Literal["zero", "access", "stuck", "nan"] | None = None
    temperature_offset_K: float = 0.0
    stamp: Literal["zero", "backwards"] | None = None
    no_ticks: bool = False
    acks_twice: bool = False
    pending: int = 0
    payload_short_bytes: int = 0
    heartbeat_most_ms: int = 60_000
    switch: Switch | None = None


@dataclass
class StreamCounts:
    """Totals since the camera was built: blocks begun, packets by fate."""

    blocks: int = 0
    packets: int = 0
    lost: int = 0
    resent: int = 0
    unavailable: int = 0


@dataclass(frozen=True)
class _Job:
    """One packet to send."""

    block: ImageBlock
    packet_id: int
    destination: Destination
    status: int = gvsp.OK


@dataclass
class _Queue:
    """What is left to do: the packets of the current block, and those asked for again, in order, each once."""

    jobs: Iterator[_Job] | None = None
    sent: threading.Event = field(default_factory=threading.Event)
    resends: dict[tuple[int, int], _Job] = field(default_factory=dict[tuple[int, int], _Job])
    refusals: deque[tuple[bytes, Destination]] = field(default_factory=deque[tuple[bytes, Destination]])

    def end_block(self) -> None:
        """The current block is over; its waiter is released."""
        self.sent.set()
        self.sent = threading.Event()
        self.jobs = None

    def empty(self) -> bool:
        """Return whether nothing waits to be sent."""
        return self.jobs is None and not self.resends and not self.refusals

    def take(self, budget_bytes: int) -> list[_Job]:
        """The next packets, repetitions first, about `budget_bytes` of them."""
        jobs: list[_Job] = []
        while budget_bytes > 0:
            job = self._next()
            if job is None:
                break
            jobs.append(job)
            budget_bytes -= job.block.packet_size
        return jobs

    def _next(self) -> _Job | None:
        if self.resends:
            return self.resends.pop(next(iter(self.resends)))
        return None if self.jobs is None else next(self.jobs, None)


class StreamSender:
    """One thread that owns the sending side of the stream socket.

    At most one block is under way; the last KEPT_BLOCKS can be asked for again. `pace_MBps` in 1e6 bytes/s.
    """

    def __init__(self, stream: socket.socket, faults: CameraFaults, pace_MBps: float) -> None:
        self._socket = stream
        self._faults = faults
        self._pace_Bps = pace_MBps * 1e6
        self._random = random.Random(faults.seed)
        self._burst_left = 0
        self._held: tuple[bytes, bytes | memoryview] | None = None  # until the next packet has left
        self._free_at_s = 0.0
        self._gap_s = 0.0
        self._left = -1  # the last packet of the current block that has left, or was skipped
        self._wake = threading.Condition()
        self._closed = threading.Event()
        self._queue = _Queue()
        self._kept: deque[tuple[ImageBlock, Destination]] = deque(maxlen=KEPT_BLOCKS)
        self.counts = StreamCounts()
        self._thread = threading.Thread(target=self._run, name="gvsp sender", daemon=True)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def close(self) -> None:
        """Stop at once; the socket stays open."""
        with self._wake:
            self._closed.set()
            self.abandon()
            self._wake.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    def begin(self, block: ImageBlock, destination: Destination, gap_s: float = 0.0) -> threading.Event:
        """Begin to send one block; the event is set when its last packet has left, or it was abandoned.

        `gap_s` is the pause that the client asked for between two packets (GevSCPD).
        """
        with self._wake:
            self._queue.end_block()
            if self._closed.is_set():
                return self._closed
            self._queue.jobs = self._jobs(block, destination)
            self._kept.append((block, destination))
            self._gap_s = gap_s + self._faults.stretch_s / block.trailer_id
            self._left = -1
            self.counts.blocks += 1
            self._wake.notify_all()
            return self._queue.sent

    def resend(self, resend: Resend) -> None:
        """Queue packets once more, those that have left; a block that is gone is answered by one UNAVAILABLE packet."""
        if self._faults.no_resend:
            return
        with self._wake:
            for block, destination in self._kept:
                if block.block_id == resend.block_id:
                    self._repeat(block, destination, resend)
                    break
            else:
                self._refuse(resend)
            self._wake.notify_all()

    def abandon(self) -> None:
        """Forget what is under way and what was kept; the caller of `begin` is released."""
        with self._wake:
            self._queue.end_block()
            self._queue = _Queue()
            self._kept.clear()

    def _jobs(self, block: ImageBlock, destination: Destination) -> Iterator[_Job]:
        skipped = {0} if self._faults.drop_leader else set[int]()
        if self._faults.drop_trailer:
            skipped.add(block.trailer_id)
        packet_ids = (packet_id for packet_id in range(block.trailer_id + 1) if packet_id not in skipped)
        return (_Job(block, packet_id, destination) for packet_id in packet_ids)

    def _repeat(self, block: ImageBlock, destination: Destination, resend: Resend) -> None:
        is_sent = self._queue.jobs is None or block is not self._kept[-1][0] or self._left >= block.trailer_id - 1
        last = block.trailer_id if is_sent else self._left
        for packet_id in range(resend.first, min(resend.last, last) + 1):
            job = _Job(block, packet_id, destination, gvsp.RESENT)
            self._queue.resends.setdefault((block.block_id, packet_id), job)

    def _refuse(self, resend: Resend) -> None:
        if not self._kept:  # nobody waits
            return
        _, destination = self._kept[-1]
        kind = gvsp.PacketKind.PAYLOAD
        header = gvsp.make_header(kind, resend.block_id, resend.first, gvsp.UNAVAILABLE, resend.extended)
        self._queue.refusals.append((header, destination))

    # -------------------------------------------------------------------------------------------------- the thread

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: not self._queue.empty() or self._closed.is_set())
                if self._closed.is_set():
                    return
                refusals = list(self._queue.refusals)
                self._queue.refusals.clear()
                jobs = self._queue.take(_BURST_bytes)
                if not jobs:
                    self._queue.end_block()
            for header, destination in refusals:
                self.counts.unavailable += 1
                self._transmit([header], destination)
            for job in jobs:
                if job.status == gvsp.RESENT:
                    self.counts.resent += 1
                else:
                    self._left = job.packet_id  # before it has: who gets it may ask for it at once
                self._mangle(job.block.packet(job.packet_id, job.status), job.destination)
                if job.status != gvsp.RESENT and job.packet_id == 0 and self._faults.leader_early_s > 0:
                    self._closed.wait(self._faults.leader_early_s)
            self._pace(sum(job.block.packet_size for job in jobs), len(jobs))

    def _mangle(self, parts: tuple[bytes, bytes | memoryview], destination: Destination) -> None:
        """Send it as the faults have it: cut, twice, or behind the next one."""
        if self._chance(self._faults.truncated):
            parts = (parts[0], parts[1][: len(parts[1]) // 2])
        if self._held is None and self._chance(self._faults.reordered):
            self._held = parts
            return
        self._transmit(parts, destination)
        if self._chance(self._faults.doubled):
            self._transmit(parts, destination)
        if self._held is not None:
            held, self._held = self._held, None
            self._transmit(held, destination)

    def _transmit(self, parts: list[bytes] | tuple[bytes, bytes | memoryview], destination: Destination) -> None:
        if self._faults.silent_gvsp:
            return
        switch = self._faults.switch
        if self._lost() or not (switch is None or switch.passes(sum(map(len, parts)))):
            self.counts.lost += 1
            return
        try:
            self._socket.sendmsg(parts, [], 0, destination)
        except OSError:  # no way to the destination: the packet is lost, as on a real wire
            self.counts.lost += 1
            return
        self.counts.packets += 1

    def _lost(self) -> bool:
        if self._burst_left > 0:
            self._burst_left -= 1
            return True
        if not self._chance(self._faults.loss):
            return False
        self._burst_left = self._faults.burst - 1
        return True

    def _chance(self, probability: float) -> bool:
        return probability > 0 and self._random.random() < probability

    def _pace(self, size_bytes: int, packets: int) -> None:
        """Wait until the wire would be free again."""
        if self._faults.unpaced:
            return
        now_s = time.monotonic()
        self._free_at_s = (
            max(self._free_at_s, now_s - _CATCH_UP_s) + size_bytes / self._pace_Bps + packets * self._gap_s
        )
        if self._free_at_s > now_s:
            self._closed.wait(self._free_at_s - now_s)
