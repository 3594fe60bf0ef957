"""What an operator says of a session through a stand's interface: kept in the session's file of notes, and published as
an event, which is recorded by the session that is open then."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.events import NOTE
from thermostand.foundation.hub import Hub
from thermostand.recording.reading.notes import add_note, add_tags, check_tag
from thermostand.recording.writing.disk import DiskCalls
from thermostand.stand.serving.desk import Who


@dataclass(frozen=True, slots=True)
class Said:
    """A sentence, tags, or both; ConfigError for neither, and for what is no tag."""

    who: Who
    text: str
    tags: Sequence[str]

    def __post_init__(self) -> None:
        if not self.text.strip() and not self.tags:
            raise ConfigError("a note needs a text or a tag")
        for tag in self.tags:
            check_tag(tag)


async def keep(said: Said, session: Path, notes: DiskCalls, hub: Hub, clock: Clock) -> None:
    """Durable when this returns; SessionError when it is not. `notes` touches the disk, which may hang."""
    await notes.call(_keep, said, session, clock.now_ns())
    who, tags = said.who, list(said.tags)
    hub.publish(NOTE.at(clock.now_ns(), said.text, who=who.name, how=who.how, session=session.name, tags=tags))


def _keep(said: Said, session: Path, now_ns: int) -> None:
    if said.text.strip():
        add_note(session, said.text, said.who.name, now_ns)
    if said.tags:
        add_tags(session, said.tags, said.who.name, now_ns)
