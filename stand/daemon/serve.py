"""A stand opened for a daemon: its addresses locked, what was left on switched off, the dead man tested."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from pathlib import Path

from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import StandTripped
from thermostand.foundation.events import DAEMON_FILE_DAMAGED, LIMITS_ACCEPTED, SALVAGED
from thermostand.foundation.files import make_folder
from thermostand.foundation.hub import Hub
from thermostand.foundation.repeats import RepeatLimit
from thermostand.recording.repair.salvage import salvage_line, salvage_unfinished
from thermostand.recording.writing.disk import FILES_LINE
from thermostand.stand.assembly import assemble
from thermostand.stand.config.checked import ATTACHMENT
from thermostand.stand.config.safe_ranges import accepted_text
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.daemon.daemon import Daemon, Front
from thermostand.stand.daemon.daemon_file import KeptFile, kept_in
from thermostand.stand.daemon.day_record import DayRecord
from thermostand.stand.daemon.reports import Reports
from thermostand.stand.queueing.orders import Orders
from thermostand.stand.running.opening.claim import claimed
from thermostand.stand.running.opening.clock_watch import ClockWatch
from thermostand.stand.running.opening.open_stand import opened
from thermostand.stand.running.opening.stand_latch import StandLatch
from thermostand.stand.running.opening.stop import Stop
from thermostand.stand.serving.alerts import alerting


async def serve(
    config: StandConfig,
    config_name: str,
    texts: dict[str, str],
    out: Path,
    front: Front,
    *,
    has_reports: bool = False,
) -> None:
    """Own the stand until SIGINT, SIGTERM, SIGQUIT or SIGHUP. texts: config.yaml, target.yaml, and the record of
    `stand check` where there is one. has_reports: whether complete runs with frames are reported.

    InUse when it belongs to another daemon or run: then nothing was touched. Raises what opening raises, and
    StandTripped when the stand could not be confirmed safe at the end.
    """
    async with Stop() as stop, claimed(config, None):
        hub, clock = Hub(RepeatLimit()), WallClock()
        await asyncio.to_thread(make_folder, out)
        kept, damage = await asyncio.to_thread(kept_in, out)
        latched = await asyncio.to_thread(StandLatch.of(config).read)
        watch = ClockWatch(hub, clock)
        assembly = assemble(config, hub, clock)
        assembly.notifier.start()
        try:
            async with AsyncExitStack() as stack:
                open_stand = await stack.enter_async_context(opened(assembly, watch.run, stop, is_for_one=False))
                await stack.enter_async_context(alerting(config.name, config.alerts, hub, clock, open_stand.is_well))
                if open_stand.disk is None:
                    raise ValueError("a daemon is on the host's clock, and has a process for its disk")
                own = {name: text for name, text in texts.items() if name in ("config.yaml", ATTACHMENT)}
                record = DayRecord(assembly, own, out, clock, stop.patience)
                keep = KeptFile(out, open_stand.disk.line(FILES_LINE).run, hub, clock)
                reports = Reports(hub, clock)
                stack.push_async_callback(reports.close)
                orders = Orders(open_stand, open_stand.disk, out, config_name, texts)
                for segment in await orders.repair.call(salvage_unfinished, out):
                    hub.publish(SALVAGED.at(clock.now_ns(), salvage_line(segment)))
                if accepted := config.accepted():
                    hub.publish(LIMITS_ACCEPTED.at(clock.now_ns(), accepted_text(accepted), **accepted))
                if damage:
                    hub.publish(DAEMON_FILE_DAMAGED.at(clock.now_ns(), damage))
                daemon = Daemon(
                    open_stand,
                    orders,
                    record,
                    kept,
                    keep,
                    latched=latched,
                    recorded=reports.add if has_reports else None,
                )
                await daemon.serve(front)
            if unsafe := assembly.stand.safety.unconfirmed:
                raise StandTripped(f"the daemon ends, but NOT SAFE: {'; '.join(unsafe)}")
        finally:
            assembly.notifier.close()
