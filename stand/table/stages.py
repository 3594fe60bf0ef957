"""The table: moves of its stages, and where the plan has put each."""

from __future__ import annotations

from collections.abc import Mapping

from drivers.devices.stage import Axis
from foundation.clock import Clock
from foundation.errors import ConfigError
from foundation.hub import Hub
from stand.interlock import Interlock, Motions
from stand.table.stage_care import check_home, ready


class Table:
    """The stages by name; what moves is shown in `motions`."""

    def __init__(
        self, axes: Mapping[str, Axis], interlock: Interlock, motions: Motions, hub: Hub, clock: Clock
    ) -> None:
        self._axes = axes
        self._interlock = interlock
        self._motions = motions
        self._hub = hub
        self._clock = clock
        self._commanded: dict[str, float] = {}  # axis -> mm or deg, where the plan put it last

    def forget(self) -> None:
        """No plan has put any stage anywhere: the run that did is over."""
        self._commanded.clear()

    async def move_to(self, axis: str, position: float) -> None:
        """Move a stage (mm or deg), homing it first when it lost its scale."""
        stage = self._axis(axis)
        self._commanded.pop(axis, None)  # its place is unknown when the move fails
        with self._motions.under_way(axis, f"to {position:g} {stage.profile.unit}"):
            homed = await stage.homed()
            self._interlock.check()  # after every wait: a fault may have closed it meanwhile
            if not homed:
                with self._motions.under_way(axis, f"homing, then to {position:g} {stage.profile.unit}"):
                    await stage.home()
                self._interlock.check()
            await stage.move_to(position)
        self._commanded[axis] = position

    async def check_home(self, axis: str) -> None:
        """Home a stage again, record how far its scale was off, and go back to where the plan had put it."""
        stage = self._axis(axis)
        with self._motions.under_way(axis, "homing"):
            await check_home(stage, self._hub, self._clock)
            self._interlock.check()
            if axis in self._commanded:
                await stage.move_to(self._commanded[axis])

    async def stop(self, axis: str) -> None:
        """Stop a stage where it is."""
        await self._axis(axis).stop()

    async def approach_again(self) -> None:
        """Before frames: approach again, from below, each stage whose motor has been switched off since its move."""
        self._interlock.check()
        with self._motions.under_way("stages", "back to the plan's positions, where they are elsewhere"):
            await ready(self._axes, self._commanded, self._hub, self._clock)

    def _axis(self, axis: str) -> Axis:
        self._interlock.check()
        if axis not in self._axes:
            raise ConfigError(f"the plan moves axis {axis}, but this stand has {', '.join(self._axes) or 'none'}")
        return self._axes[axis]
