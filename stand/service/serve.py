"""A stand opened for a daemon: its addresses locked, what was left on switched off, the dead man tested."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from pathlib import Path

from thermostand.foundation.clock import Clock, WallClock
from thermostand.foundation.errors import StandError, StandTripped
from thermostand.foundation.events import (
    DAEMON_FILE_DAMAGED,
    LIMITS_OVERRIDDEN,
    NOT_REPORTED,
    REPORT,
    REPORTED,
    SALVAGED,
    EventKind,
)
from thermostand.foundation.files import make_folder
from thermostand.foundation.hub import Hub
from thermostand.foundation.repeat_limit import RepeatLimit
from thermostand.foundation.tasks import cancel_all, describe_failure
from thermostand.foundation.worker_process import WorkerProcess
from thermostand.foundation.workers import WorkerThread
from thermostand.recording.repair.salvage import format_salvaged, salvage_unfinished
from thermostand.recording.writing.disk import FILES_LINE
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.config.check_record import ATTACHMENT
from thermostand.stand.config.safe_ranges import describe_accepted
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.opening.clock_watch import ClockWatch
from thermostand.stand.running.opening.open_stand import open_assembly
from thermostand.stand.running.opening.stand_lock import lock_stand
from thermostand.stand.running.opening.stop import Stop
from thermostand.stand.running.session_report import report_session
from thermostand.stand.service.counters import CountersFile, load_counters
from thermostand.stand.service.daemon import Daemon, Front
from thermostand.stand.service.idle_log import IdleLog
from thermostand.stand.service.run_queue import RunQueue
from thermostand.stand.serving.alerts import send_alerts
from thermostand.stand.serving.preview_process import MODULE

# The reports of runs that have come to their end, by a process of its own at the lowest priority: a session can be read
# in the morning, and nothing that guards or records waits for it.

_REPORT = "report"


def make_session_report(path: str) -> list[str]:
    """Report a session in its folder; what no temperature explains in it, a sentence each. NotReported. In the process
    that reports."""
    import cv2

    cv2.setNumThreads(1)
    return list(report_session(Path(path), Path(path)).unexplained)


class ReportQueue:
    """One after another. What goes wrong is an event `not_reported`, and nothing else."""

    def __init__(self, hub: Hub, clock: Clock) -> None:
        self._hub = hub
        self._clock = clock
        self._turn = asyncio.Lock()
        self._works: set[asyncio.Task[None]] = set()

    def add(self, session: Path) -> None:
        """Make the session's report, in its folder, when its turn has come; event `reported`."""
        work = asyncio.create_task(self._make_report(session))
        self._works.add(work)
        work.add_done_callback(self._works.discard)

    async def close(self) -> None:
        """Give up what is not made."""
        await cancel_all(list(self._works))

    async def _make_report(self, session: Path) -> None:
        async with self._turn:
            lane, helper = WorkerThread("report", self._clock, patient=False), None
            try:
                helper = WorkerProcess(MODULE, (_REPORT,), "the process that makes reports has ended")
                for line in await lane.call(helper.line(_REPORT).run, make_session_report, str(session)):
                    self._publish(REPORT, line, session=session.name)
                self._publish(REPORTED, session=session.name)
            except (StandError, OSError) as error:
                self._publish(NOT_REPORTED, str(error))
            except Exception as error:  # noqa: BLE001 - a fit that fails ends nothing
                remedy = f"`compensate report {session} -o report.html` tries again"
                self._publish(NOT_REPORTED, f"{session.name}: no report: {describe_failure(error)}; {remedy}")
            finally:
                if helper is not None:
                    helper.close()
                lane.close()

    def _publish(self, kind: EventKind, text: str = "", /, **data: object) -> None:
        self._hub.publish(kind.at(self._clock.now_ns(), text, **data))


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
    async with Stop() as stop, lock_stand(config, None):
        hub, clock = Hub(RepeatLimit()), WallClock()
        await asyncio.to_thread(make_folder, out)
        kept, damage = await asyncio.to_thread(load_counters, out)
        watch = ClockWatch(hub, clock)
        assembly = assemble(config, hub, clock)
        async with AsyncExitStack() as stack:
            open_stand = await stack.enter_async_context(open_assembly(assembly, watch.run, stop, is_for_one=False))
            await stack.enter_async_context(send_alerts(config.name, config.alerts, hub, clock, open_stand.is_well))
            if open_stand.disk is None:
                raise ValueError("a daemon is on the host's clock, and has a process for its disk")
            own = {name: text for name, text in texts.items() if name in ("config.yaml", ATTACHMENT)}
            record = IdleLog(assembly, own, out, clock, stop.shutdown_deadline)
            keep = CountersFile(out, open_stand.disk.line(FILES_LINE).run, hub, clock)
            reports = ReportQueue(hub, clock)
            stack.push_async_callback(reports.close)
            orders = RunQueue(open_stand, open_stand.disk, out, config_name, texts)
            for segment in await orders.repair.call(salvage_unfinished, out):
                hub.publish(SALVAGED.at(clock.now_ns(), format_salvaged(segment)))
            if accepted := config.list_accepted():
                hub.publish(LIMITS_OVERRIDDEN.at(clock.now_ns(), describe_accepted(accepted), **accepted))
            if damage:
                hub.publish(DAEMON_FILE_DAMAGED.at(clock.now_ns(), damage))
            daemon = Daemon(
                open_stand,
                orders,
                record,
                kept,
                keep,
                recorded=reports.add if has_reports else None,
            )
            await daemon.serve(front)
        if unsafe := assembly.stand.safety.unconfirmed:
            raise StandTripped(f"the daemon ends, but NOT SAFE: {'; '.join(unsafe)}")
