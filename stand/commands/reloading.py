"""SIGHUP to a daemon: its tokens are read again. From a terminal that is closed it ends the daemon, as SIGTERM does."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable
from pathlib import Path

from thermostand.foundation.errors import ConfigError
from thermostand.foundation.events import TOKENS_NOT_READ, TOKENS_READ
from thermostand.foundation.items import Event
from thermostand.stand.config.interface_section import TokenFile, load_tokens
from thermostand.stand.serving.api.token_book import TokenBook

Tell = Callable[[Event], None]


class Reloading:
    """From `begin` on; to be used on the control loop. path: of the tokens, None where no file is named."""

    def __init__(self, path: Path | None, book: TokenBook, now_ns: Callable[[], int], tell: Tell) -> None:
        self._path, self._book = path, book
        self._now_ns, self._tell = now_ns, tell
        self._reading: asyncio.Task[None] | None = None
        self._is_asked = False
        self._had_terminal = _has_terminal() and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN

    def begin(self) -> None:
        """SIGHUP comes here."""
        asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, self._hung_up)

    def _hung_up(self) -> None:
        if self._had_terminal and not _has_terminal():
            os.kill(os.getpid(), signal.SIGTERM)
            return
        self._is_asked = True
        if self._reading is None or self._reading.done():
            self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        while self._is_asked:
            self._is_asked = False
            try:
                event = self._renewed(await asyncio.to_thread(self._load))
            except ConfigError as error:
                event = TOKENS_NOT_READ.at(self._now_ns(), str(error))
            self._tell(event)

    def _load(self) -> TokenFile:
        if self._path is None:
            raise ConfigError("SIGHUP reads tokens again, and the stand's file names none (interface.secrets)")
        return load_tokens(self._path)

    def _renewed(self, known: TokenFile) -> Event:
        before, now = (self._book.known or TokenFile()).by_name(), known.by_name()
        self._book.renew(known)
        revoked = sorted(name for name, token in before.items() if now.get(name) != token)
        added = sorted(name for name, token in now.items() if before.get(name) != token)
        changes = [f"{name} is let in" for name in added]
        changes += [f"{name} is not let in any more" for name in revoked if name not in now]
        said = ", ".join(changes) or "nothing has changed"
        return TOKENS_READ.at(self._now_ns(), said, added=added, revoked=revoked)


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC))
    except OSError:
        return False
    return True
