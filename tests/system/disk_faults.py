"""What a disk does that acknowledged a write all the same: drawn changes of a folder's files.

A `Tree` is the content of each file by its path. `before` are the trees at earlier flushes, the oldest first: a sector
that kept its old content, or a file whose last flush was lost, has what is there, or zeros.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

Tree = dict[str, bytes]
SECTORS = (512, 4096)  # bytes


@dataclass(frozen=True)
class State:
    """A folder after a fault: `kind` and `seed` name it, `text` says what was done, `hit` are the files that are not as
    they were written; `gone_back` are those of them that are as they were at an earlier flush, or not there."""

    kind: str
    text: str
    tree: Tree
    hit: frozenset[str]
    gone_back: frozenset[str] = frozenset()
    seed: int = 0


def tree_of(folder: Path) -> Tree:
    """The files as they are, without the names that begin with a dot but the index of sessions."""
    found = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in found
        if not path.name.startswith(".") or path.name.endswith(".sqlite")
    }


def put_back(tree: Tree, folder: Path) -> None:
    """The files of a tree into an empty folder."""
    for name, data in tree.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        path.chmod(0o600)


def draw_state(before: Sequence[Tree], now: Tree, seed: int, kind: str) -> State | None:
    """One state of that kind; None when what was drawn changes nothing."""
    state = KINDS[kind](before, now, random.Random(f"{kind} {seed}"))
    return replace(state, seed=seed) if state is not None and state.hit else None


def _earlier(before: Sequence[Tree], now: Tree, name: str) -> list[bytes | None]:
    """What the file was before, None where it was not there: each once, the latest last."""
    found: list[bytes | None] = []
    for tree in before:
        data = tree.get(name)
        if data != now.get(name) and (not found or found[-1] != data):
            found.append(data)
    return found


def _file(tree: Tree, rng: random.Random, *, but: str = "") -> str:
    """Each kind of file as often as every other: there are many segments, and one latch."""
    kinds = sorted({kind_of(name) for name in tree if name != but})
    kind = rng.choice(kinds)
    return rng.choice([name for name in sorted(tree) if kind_of(name) == kind and name != but])


def kind_of(name: str) -> str:
    """`frames .part`, `journal.jsonl`, `queue.json`."""
    path = Path(name)
    if path.parent.name in ("frames", "telemetry"):
        return f"{path.parent.name} {path.suffix}"
    return "latch" if path.name.endswith(".latched.json") else path.name


def _sector(data: bytes, rng: random.Random) -> tuple[int, int]:
    """Where it begins and ends; the last one ends with the file."""
    size = rng.choice(SECTORS)
    begin = rng.randrange(max(1, -(-len(data) // size))) * size
    return begin, begin + size


def _with(data: bytes, begin: int, sector: bytes) -> bytes:
    """The sector put in its place; the file's length stays."""
    return (data[:begin] + sector + data[begin + len(sector) :])[: len(data)]


def _old(before: Sequence[Tree], now: Tree, name: str, begin: int, end: int, rng: random.Random) -> bytes:
    """What the sector held: something that the file was before, or zeros."""
    earlier = [data for data in _earlier(before, now, name) if data]
    data = rng.choice(earlier[-2:]) if earlier and rng.random() < 0.8 else b""
    return data[begin:end].ljust(end - begin, b"\0")


def _make_changed_state(kind: str, text: str, before: Sequence[Tree], now: Tree, changes: dict[str, bytes]) -> State:
    """A file of one sector that kept its old content is one whose flush was lost."""
    hit = frozenset(name for name, data in changes.items() if data != now[name])
    gone_back = frozenset(name for name in hit if any(tree.get(name) == changes[name] for tree in before))
    return State(kind, text, now | changes, hit, gone_back)


def _old_sector(before: Sequence[Tree], now: Tree, rng: random.Random) -> State:
    name = _file(now, rng)
    begin, end = _sector(now[name], rng)
    data = _with(now[name], begin, _old(before, now, name, begin, end, rng))
    return _make_changed_state("old sector", f"{name} [{begin}:{end}]", before, now, {name: data})


def _misdirect(before: Sequence[Tree], now: Tree, rng: random.Random) -> State:
    """Within a file: the sector stands in another place, and its own place keeps what was there."""
    name = _file(now, rng)
    (begin, end), (to, _) = _sector(now[name], rng), _sector(now[name], rng)
    to -= to % (end - begin)
    data = _with(now[name], begin, _old(before, now, name, begin, end, rng))
    data = _with(data, to, now[name][begin:end]) if to != begin else now[name]
    return _make_changed_state("misdirected", f"{name} [{begin}:{end}] to {to}", before, now, {name: data})


def _misdirect_elsewhere(before: Sequence[Tree], now: Tree, rng: random.Random) -> State:
    """Into another file, half of the time one of the same kind, and there in the same place."""
    name = _file(now, rng)
    alike = [other for other in sorted(now) if kind_of(other) == kind_of(name) and other != name]
    target = rng.choice(alike) if alike and rng.random() < 0.5 else _file(now, rng, but=name)
    begin, end = _sector(now[name], rng)
    to = begin if begin < len(now[target]) else 0
    changes = {target: _with(now[target], to, now[name][begin:end])}
    changes[name] = _with(now[name], begin, _old(before, now, name, begin, end, rng))
    return _make_changed_state(
        "misdirected elsewhere", f"{name} [{begin}:{end}] to {target} {to}", before, now, changes
    )


def _lose_flush(before: Sequence[Tree], now: Tree, rng: random.Random) -> State | None:
    """A file is as it was before its last flush, all others are as they are now."""
    name = _file(now, rng)
    earlier = _earlier(before, now, name)
    if not earlier:
        return None
    return _make_reverted_state("flush lost", now, {name: earlier[-1]})


def _lose_name(before: Sequence[Tree], now: Tree, rng: random.Random) -> State:
    """A file that was made or renamed is not there, but under the name it had before."""
    name = _file(now, rng)
    changes: dict[str, bytes | None] = {name: None}
    if name.endswith(".mcap"):
        changes[f"{name}.part"] = next(
            (tree[f"{name}.part"] for tree in reversed(before) if f"{name}.part" in tree), None
        )
    return _make_reverted_state("name lost", now, changes)


def _bring_back(before: Sequence[Tree], now: Tree, rng: random.Random) -> State | None:
    """A file that was removed, or renamed, is there again."""
    gone = {name: data for tree in before for name, data in tree.items() if name not in now}
    if not gone:
        return None
    name = _file(gone, rng)
    return _make_reverted_state("came back", now, {name: gone[name]})


def _make_reverted_state(kind: str, now: Tree, changes: dict[str, bytes | None]) -> State:
    tree = {name: data for name, data in (now | changes).items() if data is not None}
    names = frozenset(name for name, data in changes.items() if data != now.get(name))
    return State(kind, ", ".join(sorted(names)), tree, names, names)


KINDS: dict[str, Callable[[Sequence[Tree], Tree, random.Random], State | None]] = {
    "old sector": _old_sector,
    "misdirected": _misdirect,
    "misdirected elsewhere": _misdirect_elsewhere,
    "flush lost": _lose_flush,
    "name lost": _lose_name,
    "came back": _bring_back,
}


def states(before: Sequence[Tree], now: Tree, seeds: range) -> Iterator[State]:
    """Of each kind one for each seed, but those that change nothing."""
    for seed in seeds:
        for kind in KINDS:
            if (state := draw_state(before, now, seed, kind)) is not None:
                yield state
