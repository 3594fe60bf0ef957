"""`python -m tests.golden make|check [NAME ...]`: what the program gave before its inside was built again, by value.

demo, table: two sessions of seed 7 in virtual time, with all that is computed of them. openapi, help: what is offered.
Numbers are compared to 1e-9; everything else is exact, and each difference is reported with its place. The sessions
take minutes. `make` writes openapi and help again, which change with a reason; a session only when it is named.
"""

from __future__ import annotations

import argparse
import gzip
import json
import math
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

from tests.golden import product

DATA = Path(__file__).parent / "data"
_RELATIVE, _ABSOLUTE = 1e-9, 1e-12
_MOST = 200
"""Differences that are reported of one golden."""


def demo() -> Any:
    """The session of `make demo`: readings, steps, frames, report and datasheet."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        session = product.run(folder / "sessions", "demo")
        product.offline("report", session, "-o", folder / "report.html")
        product.offline("datasheet", session, "-o", folder / "datasheet.json")
        return product.summarise_session(session) | _documents(folder, "report.json", "datasheet.json")


def table() -> Any:
    """A short cycle, a calibration and a validation in one session, and what is computed of them."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        session = product.run(folder / "sessions", DATA / "table.yaml")
        camera, model, page = folder / "camera.json", folder / "model.json", folder / "validation.html"
        product.offline("calibrate", session, "-o", camera)
        product.offline("fit", session, "-o", model)
        product.offline("validate", session, "--camera", camera, "--model", model, "-o", page)
        return product.summarise_session(session) | _documents(folder, "camera.json", "model.json", "validation.json")


def _documents(folder: Path, *names: str) -> dict[str, Any]:
    return {name: _drop_provenance(json.loads((folder / name).read_text("utf-8"))) for name in names}


def _drop_provenance(value: Any) -> Any:
    """Without the commit, the command's folders and the hash of the session, which are others on each run."""
    if isinstance(value, dict):
        kept = cast("dict[str, Any]", value)
        return {key: _drop_provenance(each) for key, each in kept.items() if key not in ("made_by", "sha256")}
    return [_drop_provenance(each) for each in cast("list[Any]", value)] if isinstance(value, list) else value


SESSIONS: dict[str, Callable[[], Any]] = {"demo": demo, "table": table}
OFFERED: dict[str, Callable[[], Any]] = {"openapi": product.openapi, "help": product.helps}
GOLDENS = SESSIONS | OFFERED


def write(name: str, value: Any) -> None:
    """Keep it: a session packed, what is offered as text, a line each."""
    if name in SESSIONS:
        packed = gzip.compress(json.dumps(value, sort_keys=True).encode(), 9, mtime=0)
        (DATA / f"{name}.json.gz").write_bytes(packed)
    elif name == "help":
        (DATA / "help.txt").write_text("\f\n".join(f"{path}\n{text}" for path, text in value.items()), "utf-8")
    else:
        (DATA / f"{name}.json").write_text(json.dumps(value, indent=1, sort_keys=True) + "\n", "utf-8")


def load_golden(name: str) -> Any:
    """What `write` has kept."""
    if name in SESSIONS:
        return json.loads(gzip.decompress((DATA / f"{name}.json.gz").read_bytes()))
    if name == "help":
        return dict(part.split("\n", 1) for part in (DATA / "help.txt").read_text("utf-8").split("\f\n"))
    return json.loads((DATA / f"{name}.json").read_text("utf-8"))


def find_differences(kept: Any, now: Any, place: str = "") -> Iterator[str]:
    """Each place where they differ, with both. Floats are equal to 1e-9 of their size, or to 1e-12."""
    if isinstance(kept, dict) and isinstance(now, dict):
        before, after = cast("dict[str, Any]", kept), cast("dict[str, Any]", now)
        for key in sorted(before.keys() | after.keys()):
            if key not in after:
                yield f"{place}/{key}: is gone, was {_shorten(before[key])}"
            elif key not in before:
                yield f"{place}/{key}: is new, {_shorten(after[key])}"
            else:
                yield from find_differences(before[key], after[key], f"{place}/{key}")
    elif isinstance(kept, list) and isinstance(now, list):
        if len(kept) != len(now):
            yield f"{place}: has {len(now)} entries, had {len(kept)}"
        for index, (each, other) in enumerate(zip(kept, now, strict=False)):
            yield from find_differences(each, other, f"{place}/{index}")
    elif isinstance(kept, str) and isinstance(now, str) and "\n" in kept:
        yield from find_differences(kept.splitlines(), now.splitlines(), place)
    elif not _is_same(kept, now):
        yield f"{place}: is {_shorten(now)}, was {_shorten(kept)}"


def _is_same(kept: Any, now: Any) -> bool:
    numbers = all(isinstance(each, int | float) and not isinstance(each, bool) for each in (kept, now))
    if not numbers or (isinstance(kept, int) and isinstance(now, int)):
        return type(kept) is type(now) and kept == now
    if math.isnan(kept) and math.isnan(now):
        return True
    return math.isclose(kept, now, rel_tol=_RELATIVE, abs_tol=_ABSOLUTE)


def _shorten(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 100 else text[:97] + "..."


def round_trip(value: Any) -> Any:
    """As it comes back from the disk: tuples are lists."""
    return json.loads(json.dumps(value))


def main() -> int:
    """1 when something differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description="What the program gave, kept by value.")
    parser.add_argument("what", choices=("make", "check"))
    parser.add_argument("names", nargs="*", choices=[*GOLDENS, []], help=f"of {', '.join(GOLDENS)}")
    given = parser.parse_args()
    status = 0
    for name in given.names or (OFFERED if given.what == "make" else GOLDENS):
        now = round_trip(GOLDENS[name]())
        if given.what == "make":
            write(name, now)
            continue
        found = list(find_differences(load_golden(name), now))
        sys.stdout.write(f"{name}: {len(found) or 'no'} differences\n")
        sys.stdout.writelines(f"  {each}\n" for each in found[:_MOST])
        status = status or int(bool(found))
    return status


if __name__ == "__main__":
    sys.exit(main())
