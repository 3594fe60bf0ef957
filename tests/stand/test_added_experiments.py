"""Experiments of other packages, by entry points: the example of the docs, and packages that are broken."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import installed as written
from thermostand.experiments.steps import Capture, SetTemperature
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.recipe import Recipe

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "staircase"
Install = Callable[[str, str, str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Write a package as an installer leaves it: (its name, its module, "experiment = module:function" lines)."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(name: str, module: str, points: str) -> None:
        written.install(tmp_path, name, {name.replace("-", "_"): module}, {"thermostand.experiments": points})

    return write


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip has installed the example, from a wheel that it has built of it."""
    source, target = tmp_path_factory.mktemp("source") / "staircase", tmp_path_factory.mktemp("installed")
    shutil.copytree(EXAMPLE, source)
    options = [
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
        "--disable-pip-version-check",
        "--target",
        str(target),
    ]
    command = [sys.executable, "-m", "pip", "install", "-q", *options, str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target


@pytest.fixture
def staircase(built: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example, installed."""
    monkeypatch.syspath_prepend(built)


def recipe(entry: str) -> Recipe:
    return parse_document(f"name: own\nexperiments:\n  - {entry}\n", Recipe, "own.yaml")


@pytest.mark.usefixtures("staircase")
def test_the_example_is_planned_as_the_installed_ones_are():
    steps = [planned.step for planned in recipe("staircase: {stairs: 2, stair_K: 5}").plan()]
    assert [step.chamber_degC for step in steps if isinstance(step, SetTemperature)] == [29.0, 24.0, 34.0, 24.0]
    assert sum(isinstance(step, Capture) for step in steps) == 5
    assert [planned.step for planned in recipe("staircase:").plan()][-1] == steps[-1]


@pytest.mark.usefixtures("staircase")
def test_a_recipe_knows_which_packages_it_depends_on():
    assert recipe("staircase:").packages == ("thermostand-staircase 1.0",)
    assert recipe("warm_up: {}").packages == ()


@pytest.mark.usefixtures("staircase")
@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ("staircase: {stairs: 0}", "own.yaml: experiments.1.staircase.stairs: must be greater than or equal"),
        ("staircase: {stars: 3}", "own.yaml: experiments.1.staircase.stars: unknown key; correct its name, or take it"),
        ("staircase: {stair_K: 30}", "own.yaml: experiments.1.staircase: a set-point of 84 degC; give -10 to 70 degC"),
        ("stairs: {}", "there is no experiment 'stairs'; did you mean staircase? There are warm_up,"),
    ],
)
def test_what_is_wrong_with_its_parameters_is_reported_with_their_place(entry: str, sentence: str):
    with pytest.raises(ConfigError) as raised:
        recipe(entry)
    assert sentence in str(raised.value)


HEAD = "from pydantic import BaseModel\nfrom thermostand.experiments.steps import *\nclass P(BaseModel): pass\n"


@pytest.mark.parametrize(
    ("module", "sentence"),
    [
        ("import no_such_module", "acme 1.0 cannot be loaded (ModuleNotFoundError: No module named 'no_such_module')"),
        (f"{HEAD}def own(p): yield Soak(1)", "acme 1.0 cannot be loaded (KeyError"),
        (f"{HEAD}def own(p: int): yield Soak(1)", "takes no pydantic model; annotate its parameter with one"),
        (
            f"{HEAD}def own(p: P): return 1 / 0",
            "acme 1.0 makes no steps of these (ZeroDivisionError: division by zero)",
        ),
        (
            f"{HEAD}def own(p: P): yield 'soak'",
            "step 1 is no step of thermostand.experiments.steps but str; correct the package",
        ),
        (f"{HEAD}def own(p: P): yield Soak(float('nan'))", "step 1 (soak) has duration_s nan"),
        (f"{HEAD}def own(p: P): yield Soak(-1.0)", "step 1 (soak) has duration_s -1.0"),
        (f"{HEAD}def own(p: P): yield SetTemperature(30.0)", "experiments.1.own: the chamber is stopped here"),
        (
            f"{HEAD}def own(p: P):\n    while True: yield OpenFlap()",
            "experiments.1.own: the plan has more than 100000 steps or 20000 captures here",
        ),
    ],
)
def test_a_package_that_is_broken_is_named(
    module: str, sentence: str, install: Install, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
):
    name = f"acme_{abs(hash(request.node.name))}"  # each module is imported once in a process
    install("acme", "", f"own = {name}:own")
    monkeypatch.syspath_prepend(request.getfixturevalue("tmp_path"))
    (request.getfixturevalue("tmp_path") / f"{name}.py").write_text(module)
    with pytest.raises(ConfigError) as raised:
        recipe("own: {}")
    assert sentence in str(raised.value)
    assert "\n" not in str(raised.value)


def test_an_experiment_that_two_packages_have_is_refused(install: Install):
    for name in ("acme", "other"):
        install(name, "", f"own = {name}:own")
    with pytest.raises(ConfigError, match=r"own: acme 1.0 and other 1.0 have"):
        recipe("own: {}")
