"""The process that sends alerts for a daemon, see foundation/worker_process.py.

A receiver that hangs hangs this process's thread, never the daemon. The secrets are read here, again for each message,
and nothing that is returned holds any of them. A command under way when the daemon goes is run to its end.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
import signal
import subprocess
import urllib.request
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread

from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.alerts_section import load_secrets

MODULE = "thermostand.stand.serving.alerts_process"
LEFT_NAME = "stand-alert-left"  # of a process whose daemon has gone
MISSING = "alerts need Apprise: pip install 'thermostand[alerts]'"
_KILLED_LIMIT_S = 1.0  # real seconds for what was killed to be gone


Failures = list[tuple[int, str]]
"""Of each receiver that has not taken a message its number (from 1) and a sentence; number 0: nobody has."""


def deliver(secrets: Path, limit_s: float, title: str, text: str, only: Sequence[int] = ()) -> Failures:
    """Send to every address, or to those of these numbers only, limit_s real seconds for each at the same time."""
    try:
        urls = load_secrets(secrets).urls
    except ConfigError as error:
        return [(0, str(error))]
    if importlib.util.find_spec("apprise") is None:
        return [(0, MISSING)]
    _load()
    works = {
        number: _Work(lambda url=url: _send(url, title, text))
        for number, url in enumerate(urls, 1)
        if not only or number in only
    }
    return [
        (number, f"receiver {number} of {len(urls)} ({_get_scheme(urls[number - 1])}) {failure}")
        for number, work in works.items()
        if (failure := work.result(limit_s))
    ]


def ping(secrets: Path, limit_s: float) -> Failures:
    """Call the dead-man's address, if there is one."""
    try:
        url = load_secrets(secrets).alive_url
    except ConfigError as error:
        return [(0, str(error))]
    failure = _Work(lambda: _call_url(url, limit_s)).result(limit_s) if url else ""
    return [(0, f"alive_url {failure}")] if failure else []


def run_command(command: Sequence[str], limit_s: float, title: str, text: str, _only: Sequence[int] = ()) -> Failures:
    """Run it with the message as its last argument, without a shell; kill it and its children after `limit_s` real
    seconds."""
    try:
        process = subprocess.Popen(
            [*command, f"{title}: {text}".replace("\0", " ")],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # so that Ctrl-C at the stand does not end it, and its children can be found
        )
    except (OSError, ValueError) as error:
        return [(1, f"{command[0]} could not be started ({error})")]
    try:
        status = process.wait(limit_s)
    except subprocess.TimeoutExpired:
        return [(1, f"{command[0]} did not end within {limit_s:g} s{_kill(process)}")]
    return [(1, f"{command[0]} ended with status {status}")] if status else []


def _kill(process: subprocess.Popen[bytes]) -> str:
    """Kill it and its children; "" when it is gone. One that runs as another user, or hangs in the kernel, stays."""
    with suppress(OSError):
        os.killpg(process.pid, signal.SIGKILL)
    try:
        process.wait(_KILLED_LIMIT_S)
    except subprocess.TimeoutExpired:
        return " and could not be killed"
    return ""


def _get_scheme(url: str) -> str:
    scheme = url.partition("://")[0]
    return scheme if scheme.isalnum() and len(scheme) <= 20 and scheme != url else "no address"


def _load() -> None:
    """Apprise, whose log would hold addresses: it goes nowhere."""
    importlib.import_module("apprise")  # takes longer than most receivers do
    log = logging.getLogger("apprise")
    log.propagate = False
    log.handlers = [logging.NullHandler()]


def _send(url: str, title: str, text: str) -> str:
    import apprise

    sender = apprise.Apprise()
    if not sender.add(url):
        return "has an address that Apprise does not understand"
    is_taken = sender.notify(body=text, title=title, body_format=apprise.NotifyFormat.TEXT)
    return "" if is_taken else "did not take the message"


def _call_url(url: str, limit_s: float) -> str:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler())
    with opener.open(url, timeout=limit_s) as answer:
        answer.read(1000)
    return ""


class _Work:
    """A call in a thread that nobody has to wait for."""

    def __init__(self, call: Callable[[], str]) -> None:
        self._found = "did not answer in time"
        self._call = call
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def result(self, limit_s: float) -> str:
        """Return what it returned, within so long."""
        self._thread.join(limit_s)
        return self._found

    def _run(self) -> None:
        try:
            self._found = self._call()
        except Exception as error:  # noqa: BLE001 - whatever a receiver's library raises, and its text may hold a secret
            self._found = f"failed ({type(error).__name__})"
