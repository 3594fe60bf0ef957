"""What all tests share: the stock camera, and how they are dealt out to the workers."""

import gc
import itertools
import multiprocessing
import os
import signal
from collections.abc import Iterator
from pathlib import Path, PurePath

import pytest
from hypothesis import HealthCheck, settings

# Before NumPy is loaded: as the commands and `make test` have it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tests import fork_server
from tests.fork_server import STARTERS, Forks, Programs
from tests.stock_camera import run_stock_camera
from tests.workers import run_units
from thermostand.recording.writing import notices

# How long an example takes says how busy the machine is.
settings.register_profile("day", max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("nightly", settings.get_profile("day"), max_examples=500)
settings.load_profile("day")

# GVCP's port and the one address the stock camera takes are fixed: only one worker may have it.
_STOCK_CAMERA = {"tests/drivers/test_camera.py", "tests/system/test_stock_camera.py"}
# In tests/system, whose long runs have each a laboratory of its own, the tests are dealt out one by one but for those
# of a file that makes something once for all of them, or whose devices have the same serial numbers.
_states = itertools.count()
_DEALT_OUT = PurePath("tests/system")
# A worker that took these last would be the only one at work for a minute.
_LONG_FILES = {
    "tests/drivers/test_climate_chamber_losses.py",
    "tests/stand/test_page.py",
    "tests/stand/test_page_orders.py",
    "tests/stand/test_page_routes.py",
}
_TOGETHER = {
    # Real devices belong to one program by their serial numbers, whatever their addresses.
    "tests/system/test_camera_lost.py",
    "tests/system/test_camera_wire.py",
    "tests/system/test_failure_table.py",
    "tests/system/test_kill_recording.py",
}


def pytest_configure(config: pytest.Config) -> None:
    """Whatever collecting makes is kept: the garbage collector need not look through it, then or later.

    Ctrl-C and a closed terminal are for the programs that the tests start, too when the tests themselves run in the
    background of a shell or under nohup, which have them ignore these signals and pass that on."""
    for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, usual)
    gc.disable()


def pytest_collection_finish() -> None:
    """The garbage of the tests is collected, as of any program, but less often: they make many objects, few of them
    rings."""
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def runtime_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where the daemons of these tests, and those they start, have their sockets and locks."""
    with pytest.MonkeyPatch.context() as patch:
        parent = tmp_path_factory.mktemp("runtime")
        patch.setenv("XDG_RUNTIME_DIR", str(parent))
        yield parent / "thermostand"


@pytest.fixture(autouse=True)
def _own_state(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What one test leaves latched of a stand is no business of the next one, which may have its address."""
    base = request.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]
    monkeypatch.setenv("XDG_STATE_HOME", str(base / f"state-{os.getpid()}-{next(_states)}"))


@pytest.fixture(scope="session", autouse=True)
def _roomy_disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """How full this machine's disk is adds no event to what is recorded; a test's own small disks are as they are."""
    own_device, ask = tmp_path_factory.getbasetemp().stat().st_dev, notices.read_disk_space

    def roomy(folder: Path) -> notices.Space:
        space = ask(folder)
        return space._replace(free_bytes=space.total_bytes) if folder.stat().st_dev == own_device else space

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(notices, "read_disk_space", roomy)
        yield


@pytest.fixture(scope="session", autouse=True)
def _forked_programs(runtime_folder: Path) -> Iterator[None]:
    """A program that a test starts begins at once."""
    forks = None if fork_server.is_served() else Forks()
    with pytest.MonkeyPatch.context() as patch:
        for starter in STARTERS:
            patch.setattr(f"{starter}.subprocess", Programs)
        yield
    if forks:
        forks.close()


@pytest.fixture(scope="session")
def compiled_fit(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The machine code that finds markers is there: processes that begin together would each make the same."""
    _compile(tmp_path_factory.getbasetemp().parent)


def _compile(folder: Path) -> None:
    from tests.compensation.conftest import compile_fit

    compile_fit(folder / "compiling")


def _compile_first(folder: Path) -> None:
    """In a process of its own, since OpenCV's threads would not live on in the workers. On a clean checkout it takes
    half a minute, in which pyright has the other processor; a test in real time would be late beside it."""
    compiling = multiprocessing.get_context("fork").Process(target=_compile, args=(folder,))
    compiling.start()
    compiling.join()


@pytest.fixture(scope="session")
def stock_camera() -> Iterator[None]:
    """The stock Aravis fake camera answers at its address."""
    yield from run_stock_camera()


def _unit(nodeid: str) -> str:
    """The tests that go to one worker together with this one have the same unit: those of its file, mostly."""
    file = nodeid.partition("::")[0]
    if file in _STOCK_CAMERA:
        return "stock camera"
    return nodeid if PurePath(file).parent == _DEALT_OUT and file not in _TOGETHER else file


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The long ones early: those that wait in real time leave the processors to others, and no worker ends with one."""

    def turn(item: pytest.Item) -> tuple[bool, str]:
        file = item.nodeid.partition("::")[0]
        return file not in _LONG_FILES and PurePath(file).parent != _DEALT_OUT, file

    items.sort(key=turn)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.getgroup("workers")._addoption(
        "-n", dest="workers", type=int, default=0, metavar="N", help="run the tests in N processes (tests/workers.py)"
    )


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """One process forks the programs of all workers: it loads their modules once."""
    workers, are_listed = session.config.option.workers, session.config.option.collectonly
    if not workers or are_listed or session.testsfailed:
        return None  # the usual loop runs them, or says what could not be collected
    units: dict[str, list[pytest.Item]] = {}
    for item in session.items:
        units.setdefault(_unit(item.nodeid), []).append(item)
    if any("compiled_fit" in item.fixturenames for item in session.items):  # type: ignore[attr-defined]
        _compile_first(session.config._tmp_path_factory.getbasetemp())  # type: ignore[attr-defined]
    forks = Forks()
    try:
        run_units(session, list(units.values()), workers)
    finally:
        forks.close()
    return True
