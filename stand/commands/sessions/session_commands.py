"""The `stand session` commands: which there are, and where."""

from __future__ import annotations

from thermostand.foundation.usage import LazyCommand, make_lazy_app

_LIST, _WORK = "thermostand.stand.commands.sessions.session_list_cli", "thermostand.stand.commands.sessions.session_cli"

app = make_lazy_app(
    "Recorded sessions: list, look at, verify, repair, replay, export, import, trim.\n\n"
    "Example: stand session info sessions/20260101T180000Z-thermal-cycle",
    {
        "list": LazyCommand(_LIST, "The sessions in a folder: when, how long, how they ended, tags and notes."),
        "note": LazyCommand(_LIST, "Add a note to a session, also while it runs."),
        "tag": LazyCommand(_LIST, "Give a session tags, or take them away."),
        "archive": LazyCommand(
            "thermostand.stand.commands.sessions.session_archive_cli",
            "Copy finished sessions to another disk, read back.",
        ),
        "info": LazyCommand(_WORK, "What a session holds: when, steps, frames, gaps, temperatures, events, versions."),
        "verify": LazyCommand(_WORK, "Read every byte of a session and say what is damaged or missing."),
        "repair": LazyCommand(_WORK, "Finish unfinished segments and repair damaged ones."),
        "replay": LazyCommand(_WORK, "Publish a session again, at its own pace or faster."),
        "export": LazyCommand(_WORK, "A session as images, tables or one file for a viewer."),
        "import": LazyCommand(_WORK, "A session of one MCAP file that an export has written."),
        "trim": LazyCommand(_WORK, "A part of a session as a new one."),
    },
)
