"""The reports of runs that have come to their end, by a process of its own at the lowest priority: a night can be read
in the morning, and nothing that guards or records waits for it.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

from thermostand.foundation.calls import Lane
from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import StandError
from thermostand.foundation.events import NOT_REPORTED, REPORT, REPORTED, EventKind
from thermostand.foundation.helper import Helper
from thermostand.foundation.hub import Hub
from thermostand.foundation.tasks import cancelled, failure_text
from thermostand.stand.running.session_report import report_session
from thermostand.stand.serving.preview_process import MODULE

_REPORT = "report"


def session_report(path: str) -> list[str]:
    """Report a session in its folder; what no temperature explains in it, a sentence each. NotReported. In the process
    that reports."""
    import cv2

    cv2.setNumThreads(1)
    return list(report_session(Path(path), Path(path)).unexplained)


class Reports:
    """One after another. What goes wrong is an event `not_reported`, and nothing else."""

    def __init__(self, hub: Hub, clock: Clock) -> None:
        self._hub = hub
        self._clock = clock
        self._turn = asyncio.Lock()
        self._works: set[asyncio.Task[None]] = set()

    def add(self, session: Path) -> None:
        """Its report, in the session's folder, when its turn has come; event `reported`."""
        work = asyncio.create_task(self._make(session))
        self._works.add(work)
        work.add_done_callback(self._works.discard)

    async def close(self) -> None:
        """Give up what is not made."""
        await cancelled(list(self._works))

    async def _make(self, session: Path) -> None:
        async with self._turn:
            lane, helper = Lane("report", self._clock, patient=False), None
            try:
                helper = Helper(MODULE, (_REPORT,), "the process that makes reports has ended")
                for line in await lane.call(helper.line(_REPORT).run, session_report, str(session)):
                    self._tell(REPORT, line, session=session.name)
                self._tell(REPORTED, session=session.name)
            except (StandError, OSError) as error:
                self._tell(NOT_REPORTED, str(error))
            except Exception as error:  # noqa: BLE001 - a fit that fails ends nothing
                remedy = f"`compensate report {session} -o report.html` tries again"
                self._tell(NOT_REPORTED, f"{session.name}: no report: {failure_text(error)}; {remedy}")
            finally:
                if helper is not None:
                    helper.close()
                lane.close()

    def _tell(self, kind: EventKind, said: str = "", /, **data: object) -> None:
        self._hub.publish(kind.at(self._clock.now_ns(), said, **data))
