"""In every Python process with this folder in its PYTHONPATH: a host that is suspended, and whose system clock is
stepped, as the file $THERMOSTAND_MOVED_CLOCKS says: ns of suspend, ns of step, both int64."""

import mmap
import os
import struct
import time

with open(os.environ["THERMOSTAND_MOVED_CLOCKS"], "rb") as _file:
    _moved = mmap.mmap(_file.fileno(), 16, access=mmap.ACCESS_READ)
_gettime_ns, _time_ns = time.clock_gettime_ns, time.time_ns  # noqa: TID251 - the host's clocks are what is moved


def clock_gettime_ns(clock: int) -> int:
    suspended_ns, step_ns = struct.unpack("qq", _moved)
    moved_ns = {time.CLOCK_BOOTTIME: suspended_ns, time.CLOCK_REALTIME: suspended_ns + step_ns}
    return _gettime_ns(clock) + moved_ns.get(clock, 0)


def time_ns() -> int:
    return _time_ns() + sum(struct.unpack("qq", _moved))


time.clock_gettime_ns, time.time_ns = clock_gettime_ns, time_ns  # noqa: TID251
