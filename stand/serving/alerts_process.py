"""The process that sends alerts for a daemon, see foundation/helper.py.

A receiver that hangs hangs this process's thread, never the daemon. The secrets are read here, again for each message,
and nothing that is returned holds any of them.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Thread

from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.alerts_section import load_secrets

MODULE = "thermostand.stand.serving.alerts_process"
LEFT_NAME = "stand-alert-left"  # of a process whose daemon has gone
MISSING = "alerts need Apprise: pip install 'thermostand[alerts]'"


def deliver(secrets: Path, title: str, text: str, limit_s: float, only: Sequence[int] = ()) -> list[tuple[int, str]]:
    """Send to every address, or to those of these numbers (from 1) only; of each that did not take it within limit_s
    its number and a sentence. Number 0: nothing was sent to anybody. Nobody waits for them together: each has the
    whole time."""
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
        (number, f"receiver {number} of {len(urls)} ({_scheme(urls[number - 1])}) {failure}")
        for number, work in works.items()
        if (failure := work.result(limit_s))
    ]


def ping(secrets: Path, limit_s: float) -> str:
    """Call the dead-man's address; why that failed, "" when it did not, or there is none."""
    try:
        url = load_secrets(secrets).alive_url
    except ConfigError as error:
        return str(error)
    return f"alive_url {failure}" if url and (failure := _Work(lambda: _called(url, limit_s)).result(limit_s)) else ""


def _scheme(url: str) -> str:
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


def _called(url: str, limit_s: float) -> str:
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
        """What it returned, within so long."""
        self._thread.join(limit_s)
        return self._found

    def _run(self) -> None:
        try:
            self._found = self._call()
        except Exception as error:  # noqa: BLE001 - whatever a receiver's library raises, and its text may hold a secret
            self._found = f"failed ({type(error).__name__})"
