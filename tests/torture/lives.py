"""A case from its begin to its end: the program's lives one after the other, until the plan is complete."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import yaml

from tests import fork_server
from tests.torture.case import Case, stand_document, write_case

ROOT = Path(__file__).parents[2]
MOST_LIVES = 10
STILL_S, MOST_LOOKS = 240.0, 20  # a life hangs when the plant's time does not pass between two looks, of the host
_LABORATORY_S, _LOOK_S = 20.0, 0.02  # that of a program that was killed writes down what comes after
HIDDEN = "hidden"  # where a session's folder is that was lost
KILLED, COMPLETE, BAD_INPUT = -9, 0, 2


@dataclass(frozen=True, slots=True)
class Life:
    """command: what was asked. status: None for a program that hung and was killed. In real time also: when it was
    begun, had opened its doors (0: never) and was gone, by the laboratory's clock, which its own is ahead of by
    offset_ns; and the commands of the processes that were left when all was over."""

    command: list[str]
    status: int | None
    out: str
    err: str
    begun_ns: int = 0
    opened_ns: int = 0
    ended_ns: int = 0
    offset_ns: int = 0
    left: tuple[str, ...] = ()


def live(case: Case, folder: Path) -> list[Life]:
    """Run, and resume after each end but the plan's, as an operator would who has removed the cause."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / HIDDEN).mkdir(parents=True)
    (folder / "case.yaml").write_text(write_case(case))
    (folder / "stand.yaml").write_text(yaml.safe_dump(stand_document(case, folder)))
    (folder / "plan.yaml").write_text(yaml.safe_dump({"name": "torture", **case.plan}))
    out, config, lives = folder / "out", ["--config", str(folder / "stand.yaml"), "--quiet"], list[Life]()
    while len(lives) < MOST_LIVES:
        find_folder(folder)
        sessions = sorted(path.parent for path in out.glob("*/journal.jsonl") if path.stat().st_size)
        if sessions:
            command = ["resume", str(sessions[0]), *config, *(["--reset"] if lives[-1].status != KILLED else [])]
        else:
            shutil.rmtree(out, ignore_errors=True)
            command = ["run", str(folder / "plan.yaml"), *config, "--out", str(out), "--virtual-time"]
        lives.append(_life(folder, len(lives), command + ["--attended"] * case.attended))
        if lives[-1].status in (COMPLETE, None, BAD_INPUT):
            break
    find_folder(folder)
    return lives


def find_folder(folder: Path) -> bool:
    """Bring back the session's folder that was lost; whether one was."""
    lost = list((folder / HIDDEN).iterdir())
    for each in lost:
        shutil.rmtree(folder / "out" / each.name, ignore_errors=True)
        each.rename(folder / "out" / each.name)
    return bool(lost)


def _life(folder: Path, number: int, command: list[str]) -> Life:
    program = [sys.executable, "-m", "tests.torture.product", str(folder), str(number), *command]
    process = fork_server.popen(program, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    status, out, err = _wait_for_end(process, folder / f"truth-{number}.bin")
    (folder / f"output-{number}.txt").write_text(out + err)
    for _ in range(round(_LABORATORY_S / _LOOK_S)):
        if not (folder / f"begun-{number}").exists():
            break
        _wait(_LOOK_S)
    return Life(command, status, out, err)


def _wait_for_end(process: subprocess.Popen[str], truth: Path) -> tuple[int | None, str, str]:
    """Its status, None for one that hung, and what it said."""
    size = -1
    for _ in range(MOST_LOOKS):
        try:
            out, err = process.communicate(timeout=STILL_S)
        except subprocess.TimeoutExpired:
            before, size = size, truth.stat().st_size if truth.exists() else 0
            if size == before:
                break
        else:
            return process.returncode, out, err
    process.send_signal(signal.SIGUSR1)  # it says where it is
    _wait(1.0)
    process.kill()
    return None, *process.communicate()


def _wait(real_s: float) -> None:
    time.sleep(real_s)  # noqa: TID251 - other processes are waited for
