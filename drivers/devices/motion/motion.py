"""Who may move an actuator: the newest command only, and none once it was made safe, until that is taken back.

A verb takes its turn where it is called, in the event loop; the turn is checked again in the lane's thread right
before each command is written. What has been overtaken in between, while a status was awaited or a call waited in the
lane, is never sent: a stop goes through the same lane, comes after all that was sent before it, and nothing follows.
"""

from __future__ import annotations

from thermostand.foundation.errors import Superseded


class MotionCommand:
    """One command's right to move. `aim`: where to, None when no other command can mean the same; `safe`: towards the
    safe state, which is never barred."""

    def __init__(self, motion: MotionArbiter, aim: object, safe: bool) -> None:
        self.aim = aim
        self.safe = safe
        self._motion = motion

    def check(self) -> None:
        """Superseded unless this is still the command that counts; from any thread."""
        if self._motion.newest is not self:
            raise Superseded(self._motion.device, "superseded by a newer command or by making safe; not carried out")


class MotionArbiter:
    """The turns of one actuator. Taken, barred and allowed in the event loop only."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.newest: MotionCommand | None = None
        self._barred = False

    def take(self, aim: object = None, *, safe: bool = False) -> MotionCommand:
        """Let this command count from now on; one under way with the same aim continues along with it.

        Superseded, before anything is sent, when the actuator was made safe and not allowed to move since.
        """
        if self._barred and not safe:
            raise Superseded(self.device, "it was made safe and has not been allowed to move since; nothing was sent")
        if self.newest is None or aim is None or self.newest.aim != aim:
            self.newest = MotionCommand(self, aim, safe)
        return self.newest

    def bar(self) -> None:
        """Nothing moves until `allow`, but towards the safe state; what is under way otherwise has lost its turn."""
        self._barred = True
        if self.newest is not None and not self.newest.safe:
            self.newest = None

    def allow(self) -> None:
        """New commands may move again; those from before stay overtaken."""
        self._barred = False
