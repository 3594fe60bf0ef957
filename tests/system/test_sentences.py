"""No product code reads a sentence: an event's text, a reading's reason, what an error says. Programs read kind, data.

A sentence may be shown, joined and passed on. It must not be searched, taken apart, compared with a literal or used as
a key. Names that a function gives to a sentence are followed within that function.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

BETWEEN_RUNS = Path(__file__).parents[2]
FOLDERS = ("foundation", "drivers", "experiments", "recording", "markers", "stand", "compensation")
SENTENCES = {"text", "reason"}  # attributes
TAKEN_APART = {"startswith", "endswith", "removeprefix", "removesuffix", "partition", "rpartition", "split", "rsplit"}
SEARCHED = {"find", "rfind", "index", "match", "search", "fullmatch", "findall", "finditer", "sub"}
KEYED = {"add", "discard", "get", "pop", "setdefault", "count"}

# What each sentence comes from: a function without one of these need not be visited, which takes 3 s for all.
_SOURCE = re.compile(r"\.(text|reason|args)\b|\b(str|repr)\(")
# Shown, not decided upon: the sentence of an error with the file's name as it is within the session.
SHOWN = {
    ("compensation/commands/photographs_cli.py", "collect_views"),
    ("compensation/pictures.py", "measure_chunk"),
    # Compared with what was reported before and nothing else: whether a message repeats.
    ("foundation/repeat_limit.py", "_admit_sentence"),
}


class Reader(ast.NodeVisitor):
    """Finds the places of one function where a sentence is read."""

    def __init__(self) -> None:
        self.sentences: set[str] = set()  # local names
        self.errors: set[str] = set()
        self.found: list[int] = []

    def is_sentence(self, node: ast.AST) -> bool:
        match node:
            case ast.Name(id=name):
                return name in self.sentences
            case ast.Attribute(attr=name):
                return name in SENTENCES
            case ast.Call(func=ast.Name(id="str" | "repr"), args=[ast.Name(id=name)]):
                return name in self.errors
            case ast.Call(func=ast.Attribute(value=value, attr="lower" | "strip" | "casefold")):
                return self.is_sentence(value)
            case ast.Subscript(value=ast.Attribute(value=ast.Name(id=name), attr="args")):
                return name in self.errors
            case ast.ListComp(elt=element) | ast.SetComp(elt=element) | ast.GeneratorExp(elt=element):
                return self.is_sentence(element)
            case _:
                return False

    def visit_ExceptHandler(self, node: ast.ExceptHandler) -> None:
        self.errors |= {node.name} if node.name else set()
        self.generic_visit(node)

    def visit_arguments(self, node: ast.arguments) -> None:
        for argument in node.args:
            kind = ast.unparse(argument.annotation) if argument.annotation else ""
            if kind.endswith(("Error", "Exception")):
                self.errors.add(argument.arg)

    def visit_Assign(self, node: ast.Assign) -> None:
        self._named(node.targets, node.value)
        self.generic_visit(node)

    def visit_For(self, node: ast.For) -> None:
        self._named([node.target], node.iter)
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        self._named([node.target], node.iter)
        self.generic_visit(node)

    def _named(self, targets: list[ast.expr], value: ast.expr) -> None:
        if self.is_sentence(value):
            self.sentences |= {target.id for target in targets if isinstance(target, ast.Name)}

    def visit_Call(self, node: ast.Call) -> None:
        if isinstance(node.func, ast.Attribute):
            name, given = node.func.attr, any(map(self.is_sentence, node.args))
            owned = self.is_sentence(node.func.value) and not (name == "split" and not node.args)  # only its spaces
            if (owned and name in TAKEN_APART | SEARCHED) or (given and name in SEARCHED | KEYED):
                self.found.append(node.lineno)
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        sides = [node.left, *node.comparators]
        compared = [side for side in sides if not (isinstance(side, ast.Constant) and side.value in ("", None))]
        if len(compared) == len(sides) and any(map(self.is_sentence, sides)) and not self._is_of_own_kind(sides):
            self.found.append(node.lineno)
        self.generic_visit(node)

    def _is_of_own_kind(self, sides: list[ast.expr]) -> bool:
        """A text compared with another sentence, or with a named constant, is compared whole."""
        return all(self.is_sentence(side) or (isinstance(side, ast.Name) and side.id.isupper()) for side in sides)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        if self.is_sentence(node.slice):
            self.found.append(node.lineno)
        self.generic_visit(node)


def read_sentences(source: str) -> Iterator[tuple[str, int]]:
    """(function, line) of each place where one is read."""
    if not _SOURCE.search(source):
        return
    lines = source.splitlines()
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if _SOURCE.search("\n".join(lines[function.lineno - 1 : function.end_lineno])):
            reader = Reader()
            for _ in range(2):  # a comprehension's element comes before its names
                reader.found.clear()
                reader.visit(function)
            yield from ((function.name, line) for line in sorted(set(reader.found)))


def test_no_sentence_is_read():
    found = []
    for path in sorted(path for folder in FOLDERS for path in (BETWEEN_RUNS / folder).rglob("*.py")):
        name = str(path.relative_to(BETWEEN_RUNS))
        places = read_sentences(path.read_text(encoding="utf-8"))
        found += [f"{name}:{line} in {function}" for function, line in places if (name, function) not in SHOWN]
    assert found == []


@pytest.mark.parametrize(
    "line",
    [
        'event.text.startswith("capture")',
        '"lost" in event.text',
        'event.text == "operator"',
        "PATTERN.match(event.text)",
        "[PATTERN.findall(text) for text in [event.text for event in events]]",
        "reasons.add(event.text)",
        "TABLE[reading.reason]",
        'reading.reason.lower().find("alarm")',
        "text = event.text\n    text.split(' to ')",
    ],
)
def test_a_sentence_that_is_read_is_found(line: str):
    assert list(read_sentences(f"def judge(event, reading, events):\n    {line}\n"))


def test_an_error_whose_sentence_is_read_is_found():
    body = 'try:\n        work()\n    except ValueError as error:\n        return "port" in str(error)'
    assert [name for name, _ in read_sentences(f"def judge():\n    {body}\n")] == ["judge"]


def test_a_sentence_that_is_shown_is_none_of_them():
    body = 'if event.text:\n        show(f"{event.kind}: {event.text}", reading.reason or "no reason")'
    assert list(read_sentences(f"def judge(event, reading):\n    {body}\n")) == []
