"""How long a command or an import takes to begin, against the libraries that reading a session cannot do without."""

from __future__ import annotations

from pathlib import Path

from tests.bench.figures import Figure, in_turns, process_ms, ratio_at_most, side_by_side

ROUNDS = 5
PEER = ("-c", "import numpy, google.protobuf, mcap")
OURS = {
    "stand --help": ("-m", "thermostand.stand.cli", "--help"),
    "compensate --help": ("-m", "thermostand.compensation.cli", "--help"),
    "import thermostand.recording": ("-c", "import thermostand.recording"),
    "import thermostand": ("-c", "import thermostand"),
}
MOST = 2.0  # 0.3 s where the peer takes 0.15 s


def figures(folder: Path) -> list[Figure]:
    """Each beside the import of numpy, protobuf and mcap."""
    found: list[Figure] = []
    for what, words in OURS.items():
        ours, others = in_turns(lambda words=words: process_ms(*words), lambda: process_ms(*PEER), ROUNDS)
        found.append(ratio_at_most(MOST, side_by_side(what, "ms", "import numpy, google.protobuf, mcap", ours, others)))
    return found
