"""`stand service`: the daemon as a systemd service, and the device files that it needs."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import typer

from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.files import write_atomically
from thermostand.foundation.output import say, show
from thermostand.stand.commands.endpoint import ConfigArgument, ConfigOrOption, choose_config
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.safety.latch import SYSTEM_FOLDER
from thermostand.stand.serving.instances import STANDS_FOLDER

app = App()

UNITS, RULES = Path("etc/systemd/system"), Path("etc/udev/rules.d/60-thermostand.rules")
FOLDERS = Path("etc/tmpfiles.d/thermostand.conf")
_STOP_S, _WATCHDOG_S = 60, 60  # it asks for more time while the stand is being made safe


@app.callback()
def service() -> None:
    """The daemon as a service of this machine.

    Example: stand service install laboratory.yaml
    """


@app.command()
def install(
    configuration: ConfigArgument = None,
    *,
    by_option: ConfigOrOption = None,
    user: Annotated[str, typer.Option(help="The user it runs as, who owns the sessions.")] = "",
    group: Annotated[str, typer.Option(help="The group of those who may operate the stand; else that user's.")] = "",
    port: Annotated[int | None, typer.Option(help="As of `stand serve`.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Write the files; without it they are only shown.")] = False,
    root: Annotated[Path, typer.Option(help="Where the machine's folders are.", hidden=True)] = Path("/"),
) -> None:
    """Show, and with --yes write, a systemd unit for `stand serve`, udev rules for its devices, and the locks' folder.

    Example: sudo stand service install laboratory.yaml --user operator --yes
    """
    path = find_packaged("", choose_config(configuration, by_option, default="")).absolute()
    stand = load_config(path)
    name = user or os.environ.get("SUDO_USER") or os.environ.get("USER") or "root"
    for option, value in (("--user", name), ("--group", group or name)):
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_.-]{0,31}", value):
            raise ConfigError(f"{option} {value}: expected the name of a {option.strip('-')}")
    files = {
        root / UNITS / f"{make_unit_name(stand)}.service": make_unit(path, stand, name, port),
        root / RULES: make_udev_rules(name),
        root / FOLDERS: make_tmpfiles(group or name),
    }
    show({"files": {str(file): text for file, text in files.items()}, "written": yes}, _format_files(files))
    if not yes:
        say("nothing was written; --yes writes these files")
        return
    for file, text in files.items():
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, text)
    say(
        f"written; now: systemctl daemon-reload && systemctl enable --now {make_unit_name(stand)}; "
        f"udevadm control --reload && udevadm trigger; systemd-tmpfiles --create {root / FOLDERS}"
    )


def _format_files(files: Mapping[Path, str]) -> Iterator[str]:
    for file, text in files.items():
        yield f"# {file}\n{text}"


def make_unit_name(stand: StandConfig) -> str:
    """Make the name of the service's unit."""
    return f"thermostand-{re.sub(r'[^A-Za-z0-9_.-]+', '-', stand.name)}"


def make_unit(config: Path, stand: StandConfig, user: str, port: int | None) -> str:
    """The unit: restarted when it dies, watched, and given the time that making safe takes."""
    arguments = [sys.executable, "-m", "thermostand.stand.cli", "serve", str(config)]
    arguments += [] if port is None else ["--port", str(port)]
    return f"""[Unit]
Description=Thermal stand {_escape_unit(stand.name)}
After=network-online.target time-sync.target
Wants=network-online.target

[Service]
Type=notify
NotifyAccess=main
User={user}
WorkingDirectory={_escape_unit(str(config.parent))}
ExecStart={" ".join(map(_quote, arguments))}
# The tokens of the network are read again.
ExecReload=/bin/kill -HUP $MAINPID
Restart=on-failure
RestartSec=10
WatchdogSec={_WATCHDOG_S}
TimeoutStartSec=180
TimeoutStopSec={_STOP_S}
KillMode=mixed
RuntimeDirectory=lock/thermostand
RuntimeDirectoryMode=0700
RuntimeDirectoryPreserve=yes
Nice=-5
# It needs its devices, its network and the folders of its sessions, which may be anywhere.
NoNewPrivileges=yes
CapabilityBoundingSet=
ProtectSystem=full
ReadWritePaths={_escape_unit(str(config.parent))}
PrivateTmp=yes
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectControlGroups=yes
RestrictSUIDSGID=yes
LockPersonality=yes

[Install]
WantedBy=multi-user.target
"""


def make_udev_rules(user: str) -> str:
    """The flap's USB controller and the stages' serial ports belong to the user; stages keep a name of their own.
    ModemManager, which asks each new serial port for a modem by AT commands, leaves them alone."""
    ignored = 'ENV{ID_MM_DEVICE_IGNORE}="1", ENV{ID_MM_PORT_IGNORE}="1"'
    return f"""# ID_MM_...: ModemManager is not to look for modems by sending AT commands
# The flap: Pololu Jrk, by USB
SUBSYSTEM=="usb", ATTR{{idVendor}}=="1ffb", OWNER="{user}", MODE="0660", {ignored}
# Stages: XIMC controllers, as /dev/ximc/SERIAL (hexadecimal)
SUBSYSTEM=="tty", ATTRS{{idVendor}}=="1cbe", ATTRS{{idProduct}}=="0007", OWNER="{user}", MODE="0660", \\
  SYMLINK+="ximc/%s{{serial}}", {ignored}
# Serial adapters of the Modbus bus
SUBSYSTEM=="tty", SUBSYSTEMS=="usb", OWNER="{user}", MODE="0660", {ignored}
"""


def make_tmpfiles(group: str) -> str:
    """Return the file of tmpfiles.d that makes the folders for the locks and trips of this machine's stands
    (presence.lock_folder)."""
    return f"""# The locks of stands: only their operators may take one
d {STANDS_FOLDER} 2770 root {group} -
# What has tripped, and nobody has reset
d {SYSTEM_FOLDER} 2770 root {group} -
"""


def _quote(argument: str) -> str:
    """Quote a command line as systemd reads it."""
    return f'"{_escape_unit(argument)}"' if re.search(r"[\s\"'\\]", argument) else _escape_unit(argument)


def _escape_unit(text: str) -> str:
    """Percent signs are specifiers there, and a dollar begins a variable."""
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$").replace("\n", " ")
