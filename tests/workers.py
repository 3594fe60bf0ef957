"""`pytest -n N`: N processes run the tests, forked from the one that has collected them. So they share what it has
imported, where each process of its own would import, compile and collect for seconds; one that dies is replaced."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe, wait
from typing import Any, NoReturn, cast

import pytest

from tests.addresses import WORKER

Unit = Sequence[pytest.Item]
"""Tests that go to one worker, one after the other."""
_NUMBER_BYTES = 2
_MOST_UNITS = 65_536 // _NUMBER_BYTES  # what a pipe holds


def run_units(session: pytest.Session, units: Sequence[Unit], workers: int) -> None:
    """Run these tests and report them as pytest does; a worker takes the next unit when it has done one."""
    if len(units) > _MOST_UNITS:
        raise pytest.UsageError(f"{len(units)} units of tests are more than {_MOST_UNITS}")
    _write_in_one_place(session.config)
    session.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]  # is made, and kept, by this process
    crew = _Crew(session, units)
    try:
        for number in range(min(workers, len(units))):
            crew.start(number, [])
        crew.hear_all()
    finally:
        crew.end()
    if session.shouldfail:
        raise session.Failed(session.shouldfail)
    if session.shouldstop:
        raise session.Interrupted(session.shouldstop)


def _write_in_one_place(config: pytest.Config) -> None:
    """Letters of tests of several files come mixed; nothing that was printed before is printed by a worker, too."""
    reporter: Any = config.pluginmanager.getplugin("terminalreporter")
    if reporter:
        reporter.showfspath = False
        reporter.flush()
    sys.stdout.flush()
    sys.stderr.flush()


@dataclass
class _Worker:
    number: int
    process: int
    end: int
    """Can be read once the process has ended (pidfd), also while a process that a test has left holds its line."""
    left: list[pytest.Item]
    """Of the unit that it has begun."""


class _Crew:
    """The workers. The numbers of the units that none has begun lie in a pipe, from which each takes one at a time."""

    def __init__(self, session: pytest.Session, units: Sequence[Unit]) -> None:
        self._session, self._units, self._members = session, units, dict[Connection, _Worker]()
        self._queue, filling = os.pipe()
        os.write(filling, b"".join(number.to_bytes(_NUMBER_BYTES, "little") for number in range(len(units))))
        os.close(filling)

    def start(self, number: int, first: list[pytest.Item]) -> None:
        """One worker more, which begins with these tests."""
        line, end = Pipe(duplex=False)
        process = os.fork()
        if not process:
            for other in (line, *self._members):
                other.close()
            _work(_Task(self._session, end, self._units, self._queue), number, first)
        end.close()
        self._members[line] = _Worker(number, process, os.pidfd_open(process), first)

    def hear_all(self) -> None:
        """Report what they do until all have ended."""
        while self._members:
            lines = {worker.end: line for line, worker in self._members.items()}
            for ready in wait([*lines, *lines.values()]):
                line = lines[ready] if isinstance(ready, int) else cast(Connection, ready)
                if line in self._members and (line is ready or not line.poll()):
                    self._hear(line, has_ended=line is not ready)
            if self._session.shouldfail or self._session.shouldstop:
                self._drain()

    def end(self) -> None:
        """Wait until each has done its unit; none begins another."""
        self._drain()
        for line, worker in self._members.items():
            line.close()
            os.close(worker.end)
            os.waitpid(worker.process, 0)
        os.close(self._queue)

    def _drain(self) -> None:
        while os.read(self._queue, 4096):
            pass

    def _hear(self, line: Connection, *, has_ended: bool) -> None:
        hook, worker = self._session.config.hook, self._members[line]
        word, value = "end", None
        if not has_ended:
            with suppress(EOFError, ConnectionResetError):
                word, value = line.recv()
        if word == "unit":
            worker.left = list(self._units[cast(int, value)])
        elif word == "begins":
            hook.pytest_runtest_logstart(nodeid=worker.left[0].nodeid, location=worker.left[0].location)
        elif word == "report":
            report = hook.pytest_report_from_serializable(config=self._session.config, data=value)
            hook.pytest_runtest_logreport(report=report)
        elif word == "ended":
            item = worker.left.pop(0)
            hook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        else:
            self._bury(line, worker)

    def _bury(self, line: Connection, worker: _Worker) -> None:
        """Where it ended amid a unit, its test has failed and another takes the tests after it."""
        del self._members[line]
        line.close()
        os.close(worker.end)
        status = os.waitstatus_to_exitcode(os.waitpid(worker.process, 0)[1])
        if not worker.left:
            return
        item, *rest = worker.left
        why = f"worker {worker.number} ended in this test, with {status}"
        report = pytest.TestReport(item.nodeid, item.location, {}, "failed", why, "call")
        self._session.config.hook.pytest_runtest_logreport(report=report)
        if not self._session.shouldfail:
            self.start(worker.number, rest)


@dataclass(frozen=True)
class _Task:
    """What a worker has of the others: the line to report to, and the queue."""

    session: pytest.Session
    line: Connection
    units: Sequence[Unit]
    queue: int


def _work(task: _Task, number: int, first: Unit) -> NoReturn:
    """The life of a worker."""
    status = 1
    try:
        _become(task.session.config, number, task.line)
        last = _run(task, first)
        while not task.session.shouldfail and (taken := os.read(task.queue, _NUMBER_BYTES)):
            unit = int.from_bytes(taken, "little")
            task.line.send(("unit", unit))
            last = _run(task, task.units[unit])
        if last:
            _take_down(task.session, last)
        status = 0
    except BaseException:  # noqa: BLE001 - it is shown, and the worker ends
        traceback.print_exc()
    os._exit(status)


def _become(config: pytest.Config, number: int, line: Connection) -> None:
    """This process has its own captured output, folder and addresses, and reports to the line."""
    plugins, tmp_path_factory = config.pluginmanager, config._tmp_path_factory  # type: ignore[attr-defined]
    capture: Any = plugins.getplugin("capturemanager")
    capture.stop_global_capturing()
    capture.start_global_capturing()
    capture.suspend_global_capture()
    plugins.unregister(name="terminalreporter")
    plugins.register(_Reporter(config, line))
    os.environ[WORKER] = str(number)
    tmp_path_factory._given_basetemp = tmp_path_factory.getbasetemp() / f"worker-{number}-{os.getpid()}"
    tmp_path_factory._basetemp = None


@dataclass(frozen=True)
class _Reporter:
    config: pytest.Config
    line: Connection

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        data = self.config.hook.pytest_report_to_serializable(config=self.config, report=report)
        self.line.send(("report", data))


def _run(task: _Task, unit: Unit) -> pytest.Item | None:
    """Run these tests; return the last one. What lasts as long as the worker is kept after it."""
    after: Sequence[Any] = [*unit[1:], task.session]
    for item, following in zip(unit, after, strict=False):
        task.line.send(("begins", None))
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        task.line.send(("ended", None))
        if task.session.shouldfail:
            break
    return unit[-1] if unit else None


def _take_down(session: pytest.Session, last: pytest.Item) -> None:
    """End what lasted as long as the worker; a fault of it is one of its last test."""
    hook = session.config.hook
    call = pytest.CallInfo.from_call(lambda: session._setupstate.teardown_exact(None), "teardown")
    report = hook.pytest_runtest_makereport(item=last, call=call)
    if report.failed:
        hook.pytest_runtest_logreport(report=report)
