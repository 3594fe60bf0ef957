"""How much of the files of a salvage has been read."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

ReportShare = Callable[[float, str], None]
"""Gets the share that is done, 0 to 1, and the file at hand."""


def no_report(share: float, text: str) -> None:
    """No progress is shown."""


class ShareDone:
    """Of `paths`; each is read from its begin to its end, perhaps more than once."""

    def __init__(self, paths: Iterable[Path], report: ReportShare) -> None:
        self._sizes = {path: _size(path) for path in paths}
        self._total = max(1, sum(self._sizes.values()))
        self._report = report
        self._done = 0

    def within(self, path: Path) -> Callable[[int], None]:
        """To be called with how many bytes of `path` have been read."""
        return lambda read_bytes: self._report(min(1.0, (self._done + read_bytes) / self._total), path.name)

    def finished(self, path: Path) -> None:
        """All that is to be done with `path` is done."""
        self._done += self._sizes.pop(path, 0)
        self._report(min(1.0, self._done / self._total), path.name)


def _size(path: Path) -> int:
    with suppress(OSError):
        return path.stat().st_size
    return 0
