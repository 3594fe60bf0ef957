"""The recording of a run: its folder, what is known of it beforehand, and its recorder."""

from __future__ import annotations

import hashlib
import importlib.metadata
import itertools
import os
import platform
import secrets
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from thermostand.drivers.settings import make_identity_event
from thermostand.foundation.clock import NS_PER_S, Clock, VirtualClock
from thermostand.foundation.documents import parse_document
from thermostand.foundation.events import ABSENT, SEARCH_FAILED
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.markers.target import Target
from thermostand.recording.format.images import MarkerWindows
from thermostand.recording.writing.disk import DiskProcess
from thermostand.recording.writing.recorder import Recorder, RecordingSettings, SessionInfo
from thermostand.recording.writing.recorder_settings import VIRTUAL_COMMIT_S
from thermostand.stand.assembly.assemble import Assembly, list_recorded_devices
from thermostand.stand.config.stand_config import RecordingConfig, StandConfig
from thermostand.stand.estimating.missing_devices import list_missing_devices
from thermostand.stand.running.order import Order


def choose_session_directory(out: Path, order: Order, clock: Clock) -> Path:
    """A new folder for the session below `out`, named for the instant and the recipe; `-2`, `-3` ... when there is one
    already: in virtual time every run of a recipe begins at the same instant."""
    started = datetime.fromtimestamp(clock.now_ns() / NS_PER_S, UTC)
    name = f"{started:%Y%m%dT%H%M%SZ}-{order.recipe.name}"
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    return next(directory for directory in map(out.joinpath, names) if not os.path.lexists(directory))


def make_session_info(
    recipe: str, session: str, config: StandConfig, camera_serial: str, clock: Clock, seed: int | None = None
) -> SessionInfo:
    """Make the description of who records what with which; `seed`: of a run in virtual time."""
    is_virtual = isinstance(clock, VirtualClock)
    return SessionInfo(
        session_id=session,
        recipe=recipe,
        operator=config.operator,
        camera_serial=camera_serial,
        software_version=importlib.metadata.version("thermostand"),
        clock_source="virtual" if is_virtual else "wall",
        simulated=config.simulation is not None,
        host=platform.node(),
        uid=hashlib.sha256(f"{seed} {session}".encode()).hexdigest()[:16] if is_virtual else secrets.token_hex(8),
    )


def list_camera_serials(assembly: Assembly) -> str:
    """List which cameras have answered; "" on a stand without any."""
    return ", ".join(camera.identity.serial_number for camera in assembly.devices.cameras.values())


def publish_identities(assembly: Assembly, tell: Callable[[Event], None]) -> None:
    """Publish which devices have answered, as events, but for the cameras, which are reported when they are on; and
    what the stand lacks. tell: gets them."""
    devices, now_ns = assembly.devices, assembly.clock.now_ns()
    for name, device in devices.every.items():
        if name not in devices.cameras and device.identity is not None:
            tell(make_identity_event(name, device.identity, now_ns))
    for absence in list_missing_devices(assembly.config):
        tell(ABSENT.at(now_ns, absence.means, what=absence.what))


def make_run_recorder(
    order: Order, directory: Path, info: SessionInfo, assembly: Assembly, disk: DiskProcess | None = None
) -> Recorder:
    """The recorder of this run; `disk` is the process that touches the disk for it."""
    windows = _make_marker_windows(order)
    attachments, hub, clock = order.attachments(), assembly.hub, assembly.clock
    recorder = make_recorder(directory, info, attachments, order.config, hub, clock, disk=disk, windows=windows)
    if windows is not None:
        windows.tell = partial(recorder.tell, SEARCH_FAILED)
    return recorder


def make_recorder(
    directory: Path,
    info: SessionInfo,
    attachments: Mapping[str, str],
    config: StandConfig,
    hub: Hub,
    clock: Clock,
    *,
    disk: DiskProcess | None = None,
    windows: MarkerWindows | None = None,
) -> Recorder:
    """A recorder with the stand's settings. `roi` frames need `windows`; without them they are whole."""
    settings = RecordingSettings(
        config.recording.frame_encoding,
        _compute_commit_s(config.recording, clock),
        stop_frames_below_bytes=round(config.recording.stop_frames_below_GB * 1e9),
        alert_below_fraction=config.recording.alert_below_percent / 100,
    )
    devices = list_recorded_devices(config)
    return Recorder(directory, info, attachments, devices, hub, clock, settings=settings, prepare=windows, disk=disk)


def _compute_commit_s(recording: RecordingConfig, clock: Clock) -> float:
    """Return the time between commits of telemetry: on a virtual clock few, but nothing waits for half of what a guard
    allows."""
    if isinstance(clock, VirtualClock):
        return min(VIRTUAL_COMMIT_S, recording.durable_within_s / 3)
    return min(recording.telemetry_commit_s, recording.durable_within_s / 3)


def _make_marker_windows(order: Order) -> MarkerWindows | None:
    """Make, for `roi`, what keeps the surroundings of the target's markers."""
    recording = order.config.recording
    if recording.frame_encoding != "roi":
        return None
    target = parse_document(order.target_text, Target, order.config.target)
    from thermostand.markers.windows import (
        find_marker_windows,
    )  # scipy takes half a second that other runs need not wait for

    return MarkerWindows(partial(find_marker_windows, target=target), recording.whole_every_s)
