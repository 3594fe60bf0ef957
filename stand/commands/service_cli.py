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
from thermostand.foundation.files import write_whole
from thermostand.foundation.output import say, show
from thermostand.stand.commands.reached import ConfigArgument, ConfigOrOption, named_config
from thermostand.stand.config.stand_config import StandConfig, load_config, packaged
from thermostand.stand.latch import SYSTEM_FOLDER
from thermostand.stand.serving.presence import STANDS_FOLDER

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
    path = packaged("", named_config(configuration, by_option, default="")).absolute()
    stand = load_config(path)
    name = user or os.environ.get("SUDO_USER") or os.environ.get("USER") or "root"
    for option, value in (("--user", name), ("--group", group or name)):
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_.-]{0,31}", value):
            raise ConfigError(f"{option} {value}: expected the name of a {option.strip('-')}")
    files = {
        root / UNITS / f"{unit_name(stand)}.service": unit(path, stand, name, port),
        root / RULES: rules(name),
        root / FOLDERS: folders(group or name),
    }
    show({"files": {str(file): text for file, text in files.items()}, "written": yes}, _shown(files))
    if not yes:
        say("nothing was written; --yes writes these files")
        return
    for file, text in files.items():
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, text)
    say(
        f"written; now: systemctl daemon-reload && systemctl enable --now {unit_name(stand)}; "
        f"udevadm control --reload && udevadm trigger; systemd-tmpfiles --create {root / FOLDERS}"
    )


def _shown(files: Mapping[Path, str]) -> Iterator[str]:
    for file, text in files.items():
        yield f"# {file}\n{text}"


def unit_name(stand: StandConfig) -> str:
    """Of the service."""
    return f"thermostand-{re.sub(r'[^A-Za-z0-9_.-]+', '-', stand.name)}"


def unit(config: Path, stand: StandConfig, user: str, port: int | None) -> str:
    """The unit: restarted when it dies, watched, and given the time that making safe takes."""
    arguments = [sys.executable, "-m", "thermostand.stand.cli", "serve", str(config)]
    arguments += [] if port is None else ["--port", str(port)]
    return f"""[Unit]
Description=Thermal stand {_of_unit(stand.name)}
After=network-online.target time-sync.target
Wants=network-online.target

[Service]
Type=notify
NotifyAccess=main
User={user}
WorkingDirectory={_of_unit(str(config.parent))}
ExecStart={" ".join(map(_quoted, arguments))}
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
ReadWritePaths={_of_unit(str(config.parent))}
PrivateTmp=yes
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectControlGroups=yes
RestrictSUIDSGID=yes
LockPersonality=yes

[Install]
WantedBy=multi-user.target
"""


def rules(user: str) -> str:
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


def folders(group: str) -> str:
    """Where the locks of this machine's stands lie (presence.lock_folder)."""
    return f"""# The locks of stands: only their operators may take one
d {STANDS_FOLDER} 2770 root {group} -
# What has tripped, and nobody has reset
d {SYSTEM_FOLDER} 2770 root {group} -
"""


def _quoted(argument: str) -> str:
    """As systemd reads a command line."""
    return f'"{_of_unit(argument)}"' if re.search(r"[\s\"'\\]", argument) else _of_unit(argument)


def _of_unit(text: str) -> str:
    """Percent signs are specifiers there, and a dollar begins a variable."""
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$").replace("\n", " ")
