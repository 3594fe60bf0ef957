"""A client of a daemon's interface, by hand."""

from pathlib import Path

from tests.daemon_queries import ask
from thermostand.foundation.errors import SessionError
from thermostand.stand.serving.instances import DaemonEntry, list_daemons


def entries_of(session: Path) -> list[DaemonEntry]:
    """What the daemons that run `session` say of themselves; on this machine there may be others."""
    return [each.entry for each in list_daemons() if each.entry.session == str(session)]


def obeys(session: Path) -> bool:
    """Whether a daemon that runs `session` takes a stop."""
    try:
        return ask(session, "stop")["verb"] == "stop"
    except SessionError:
        return False


DAEMON = """
import asyncio, sys
from pathlib import Path
from tests.stand.fake_service import FakeService, serve_fake

async def run():
    async with serve_fake(FakeService(), Path(sys.argv[1])):
        print("ready", flush=True)
        await asyncio.Event().wait()

asyncio.run(run())
"""
