"""How long a command or an import takes to begin, against the libraries that reading a session cannot do without."""

from __future__ import annotations

from pathlib import Path

from tests.bench.figures import Figure, compare, measure_in_turns, measure_process_ms, set_upper_ratio_goal

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
        ours, others = measure_in_turns(
            lambda words=words: measure_process_ms(*words), lambda: measure_process_ms(*PEER), ROUNDS
        )
        found.append(
            set_upper_ratio_goal(MOST, compare(what, "ms", "import numpy, google.protobuf, mcap", ours, others))
        )
    return found
