"""The table of tests and of mistakes that are none says what there is: tests/torture/mutants.py."""

from __future__ import annotations

import ast

import pytest

from tests.torture.lives import ROOT
from tests.torture.mutants import mutant, places, table

TABLE = table()


@pytest.mark.parametrize("file", TABLE["tests"])
def test_a_file_has_tests_that_exist(file: str):
    assert (ROOT / file).is_file()
    names = " ".join(TABLE["tests"][file]).split()
    assert [name for name in names if not (ROOT / name).is_file()] == []


def test_a_mistake_that_is_none_is_one_of_its_file_as_it_is():
    lines = {file: ast.unparse(ast.parse((ROOT / file).read_text(encoding="utf-8"))) for file in TABLE["tests"]}
    for each in TABLE["equivalent"]:
        assert each["was"] != each["now"]
        assert each["why"]
        assert all(line in lines[each["file"]] for line in each["was"].splitlines()), each


def test_mistakes_are_made_where_something_is_done_and_nowhere_in_texts():
    source = 'def f(x: int = 3) -> str:\n    if x < 2 and x:\n        print(x)\n    return f"{x + 1}"\n'
    made = [mutant("f.py", source, *place) for place in places(source)]
    assert [(each.line, each.now) for each in made] == [
        (2, "if not (x < 2 and x):"),
        (1, "def f(x: int=30) -> str:"),
        (2, "if x < 2 or x:"),
        (3, "None"),
        (2, "if x <= 2 and x:"),
        (2, "if x < 20 and x:"),
    ]
