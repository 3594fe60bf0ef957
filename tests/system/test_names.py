"""Words that are not the field's own do not come back as names: of files, in Python, in the page, in recorded keys.

Prose may use them properly, and `docs/glossary.md` lists the proper uses. Names in it are allowed here.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GONE = frozenset(
    word
    for group in (
        ("said", "told", "room", "rooms", "night", "nights", "doubt", "doubts", "doubted", "doubtful", "beside"),
        ("aside", "there", "house", "houses", "floors", "felt", "earned", "owed", "worth", "torn", "anew", "whoever"),
    )
    for word in group
)
FOLDERS = ("foundation", "drivers", "experiments", "recording", "markers", "stand", "compensation", "tests", "docs")
GLOSSARY = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
PROPER = set(re.findall(r"`(\w+)`", GLOSSARY.partition("## Words with one proper use")[2]))
# Of a page's source: names of classes in CSS, and what JavaScript declares.
_CSS, _SCRIPT = (
    re.compile(r"\.([a-z][\w-]*)"),
    re.compile(r"\b(?:const|let|function|class)\s+([\w$]+)|(\w+) =>|class: \"([^\"]+)"),
)
# Of Python: docstrings, comments and texts; and names, which a text of one word is, too.
_TEXT = re.compile(r'"""(?s:.*?)"""|#.*|"(?:[^"\\\n]|\\.)*"|\'(?:[^\'\\\n]|\\.)*\'')
_NAME = re.compile(r"[A-Za-z_]\w*")
_KEY = re.compile(r"^\s*(?:- )?\"?([a-z]\w*)\"?:", re.MULTILINE)


def list_words(name: str) -> set[str]:
    """The words of a name, in lower case: `set_aside` and `setAside` have two."""
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}


def list_python_names(source: str) -> Iterator[str]:
    """Identifiers, and the texts of one word that are keys or names themselves; a tokenizer takes ten times as long."""
    yield from set(_NAME.findall(_TEXT.sub(lambda text: text[0] if text[0][1:-1].isidentifier() else " ", source)))


def list_names(path: Path) -> Iterator[str]:
    """Every name that a file gives to something, and its own."""
    yield path.name
    if path.suffix == ".py":
        yield from list_python_names(path.read_text(encoding="utf-8"))
    elif path.suffix in (".yaml", ".json"):
        yield from _KEY.findall(path.read_text(encoding="utf-8"))
    elif path.suffix in (".css", ".js", ".jinja") and path.name != "uPlot.js":
        pattern = _SCRIPT if path.suffix == ".js" else _CSS
        for found in pattern.finditer(path.read_text(encoding="utf-8")):
            yield next(each for each in found.groups() if each)


def test_words_with_a_better_one_name_nothing() -> None:
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.is_file()]
    assert len(files) > 1000
    found = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in files
        if path != Path(__file__) and "__pycache__" not in path.parts
        for name in list_names(path)
        if name not in PROPER and list_words(name) & GONE
    }
    assert sorted(found) == []


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("a.py", "set_aside = 1"),
        ("a.py", 'row = {"doubted_s": 1}'),
        ("a.py", "def test_it_is_there(): ..."),
        ("a.py", "class NightDesk: ..."),
        ("night_desk.py", ""),
        ("a.css", ".said { color: red }"),
        ("a.js", "const nights = 1;"),
        ("a.yaml", "not_told: x"),
        ("a.json", ' "between_nights_px": 1'),
    ],
)
def test_such_a_name_is_found_wherever_it_is(tmp_path: Path, name: str, source: str) -> None:
    (tmp_path / name).write_text(source, encoding="utf-8")
    assert [each for each in list_names(tmp_path / name) if list_words(each) & GONE]
