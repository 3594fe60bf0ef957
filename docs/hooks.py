"""Pages that are made when the site is built, each from the one place that defines what it lists.

A page is either made whole (the files' references, from their schemas) or has a line `<!-- made: NAME -->`, which is
replaced by what the function of that name gives: the steps, the events, the commands, the routes, the model file.
A line `<!-- included: PATH -->` is replaced by that file of the project, as code.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files
from pydantic import TypeAdapter
from typer.main import get_command

from thermostand.compensation.cli import app as compensate
from thermostand.compensation.commands.schema_cli import DOCUMENTS as OFFLINE
from thermostand.compensation.drift.model_file import PaperFile, ThermalFile
from thermostand.experiments.steps import STEPS, Step
from thermostand.foundation.schemas import make_schema
from thermostand.stand.commands.command_table import app as stand
from thermostand.stand.commands.config_cli import DOCUMENTS
from thermostand.stand.commands.remedies import make_troubleshooting_page

ROOT = Path(__file__).parents[1]
OPENAPI = ROOT / "tests" / "golden" / "data" / "openapi.json"  # a test holds that it is what a stand answers
NOTEBOOK = ROOT / "docs" / "tutorials" / "simulated-session.ipynb"
FILES = {
    "stand": ("stand-file", "A stand's file"),
    "recipe": ("recipe-file", "A recipe"),
    "registers": ("register-map", "A register map"),
    "target": ("target-file", "A target"),
    "geometry": ("geometry-file", "A stand's geometry"),
    "details": ("details-file", "Details of a measurement"),
    "mapping": ("mapping-file", "A mapping of a table"),
    "order": ("order-file", "An order of a certificate"),
}


# A configuration file's reference, from its JSON Schema: each key with its kind, bounds and default.

Schema = Mapping[str, Any]
_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def make_reference(title: str, schema: Schema) -> str:
    """A page: what the file has at its top, then a section for each model, in the order in which they are named."""
    models = cast("dict[str, Schema]", schema.get("$defs", {}))
    lines = [f"# {title}", "", *_describe_model(schema)]
    for name, model in models.items():
        if "properties" in model:
            lines += ["", f"## {name}", "", *_describe_model(model)]
    return "\n".join(lines) + "\n"


def _describe_model(model: Schema) -> Iterator[str]:
    if text := str(model.get("description", "")):
        yield _escape_markdown(text)
        yield ""
    yield "| key | what | default |"
    yield "|---|---|---|"
    needed = set(cast("list[str]", model.get("required", [])))
    for key, value in cast("dict[str, Schema]", model.get("properties", {})).items():
        default = "to be given" if key in needed else f"`{value['default']}`" if "default" in value else ""
        yield f"| `{key}` | {_describe_kind(value)} | {default.replace('|', '/')} |"


def _describe_kind(value: Schema) -> str:
    """Return what may stand there; models as links to their sections."""
    if "$ref" in value:
        name = str(value["$ref"]).rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if "const" in value:
        return f"`{value['const']}`"
    if "enum" in value:
        return " or ".join(f"`{each}`" for each in value["enum"])
    for several in ("anyOf", "oneOf", "allOf"):
        if several in value:
            kinds = [_describe_kind(each) for each in value[several] if each.get("type") != "null"]
            return " or ".join(dict.fromkeys(kinds)) + _describe_bounds(value)
    kind = str(value.get("type", "anything"))
    if kind == "array":
        items = value.get("items") or next(iter(value.get("prefixItems", [])), {})
        return f"list of {_describe_kind(items)}"
    if kind == "object" and isinstance(value.get("additionalProperties"), Mapping):
        return f"by name: {_describe_kind(value['additionalProperties'])}"
    return kind + _describe_bounds(value)


def _describe_bounds(value: Schema) -> str:
    found = [f"{sign} {value[name]}" for name, sign in _BOUNDS.items() if name in value]
    return f" {', '.join(found)}" if found else ""


def _escape_markdown(text: str) -> str:
    """Escape a text so that no line of it is taken for Markdown's own."""
    return " ".join(text.split()).replace("<", "&lt;").replace("*", "\\*")


def on_files(files: Files, config: Any) -> Files:
    """Add a page for each schema, and the notebook as it was last executed."""
    for name, (page, title) in FILES.items():
        schema = make_schema({**DOCUMENTS, **OFFLINE}[name])
        files.append(File.generated(config, f"reference/{page}.md", content=make_reference(title, schema)))
    if not NOTEBOOK.exists():
        return files
    text, pictures = executed(json.loads(NOTEBOOK.read_text(encoding="utf-8")))
    files.append(File.generated(config, "tutorials/notebook.md", content=text))
    for name, data in pictures.items():
        files.append(File.generated(config, f"tutorials/{name}", content=data))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill in what is made or included, and write equations as MathML, which browsers draw by themselves. A default
    that is nothing is not shown."""
    markdown = re.sub(r"<!-- made: (\w+) -->", lambda found: MADE[found[1]](), markdown)
    markdown = re.sub(r"<!-- included: (\S+) -->", lambda found: _included(ROOT / found[1]), markdown)
    markdown = markdown.replace("| `` |", "| |").replace("| `None` |", "| |")
    return markdown if "```math" not in markdown else _EQUATION.sub(_drawn, markdown)


# An equation of its own, one within a line, or code, which is left as it is.
_EQUATION = re.compile(r"```math\n(?P<block>.*?)\n```|(?P<code>```.*?```|`[^`\n]+`)|\$(?P<inline>[^$\n]+)\$", re.DOTALL)


def _drawn(found: re.Match[str]) -> str:
    if found["code"]:
        return found[0]
    if found["block"]:
        return f'<div class="equation">{convert(found["block"], display="block")}</div>'
    return f"<span>{convert(found['inline'])}</span>"  # a line that begins with <math> would be taken for a block


def _included(path: Path) -> str:
    language = {".py": "python", ".toml": "toml"}[path.suffix]
    return f"```{language}\n{path.read_text(encoding='utf-8').rstrip()}\n```"


def executed(notebook: Any) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, and the pictures that it shows, by their names."""
    lines, pictures = list[str](), dict[str, bytes]()
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        lines += [source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```", ""]
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                name = f"notebook-{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode("".join(data["image/png"]))
                lines += [f"![What the cell above draws]({name})", ""]
            else:
                text = "".join(output.get("text", data.get("text/plain", ""))).rstrip()
                lines += ["```text", text, "```", ""]
    return "\n".join(lines), pictures


def steps() -> str:
    """Each kind of step that a recipe can name: what it does, and its keys."""
    return "\n".join(line for kind in STEPS.values() if kind.in_recipes for line in _step(kind))


def _step(kind: type[Step]) -> Iterator[str]:
    yield from (f"## {kind.kind}", "", _paragraphs(kind.__doc__ or ""), "")
    yield "Restored after an interruption." if kind.is_setup else "Done once; work that was interrupted is done again."
    if kind.form is None:
        yield from ("", f"Written as `- {kind.kind}`, with nothing behind it.", "")
        return
    schema = TypeAdapter(kind.form).json_schema(mode="validation")
    table = make_reference("", schema).partition("\n\n")[2]
    if "properties" in schema:
        yield from ("", table)
        return
    models = [model for model in schema.get("$defs", {}).values() if "properties" in model]
    for model in models:
        yield from ("", make_reference("", model).partition("\n\n")[2])
    if not models:
        shown = {"type": "object", "properties": {kind.kind: schema}, "required": [kind.kind]}
        yield from ("", make_reference("", shown).partition("\n\n")[2])


def _paragraphs(text: str) -> str:
    return "\n\n".join(" ".join(each.split()) for each in text.split("\n\n"))


def events() -> str:
    """The table of events, without the head of its page."""
    text = make_troubleshooting_page()
    table = text[text.index("| event |") :]
    return table.replace("{", "&#123;").replace("}", "&#125;")  # else the last ones of a cell are taken for attributes


def stand_commands() -> str:
    """The commands of `stand`."""
    return "\n".join(_commands(get_command(stand), "stand"))


def compensate_commands() -> str:
    """The commands of `compensate`."""
    return "\n".join(_commands(get_command(compensate), "compensate"))


def _commands(command: Any, name: str) -> Iterator[str]:
    """A section for each command, those in groups included. The options that all commands have are left out."""
    context = command.context_class(command, info_name=name)
    if hasattr(command, "list_commands"):
        for child in command.list_commands(context):
            yield from _commands(command.resolve_command(context, [child])[1], f"{name} {child}")
        return
    yield from (f"## {name}", "", _help(command.help or ""), "")
    own = [each for each in command.params if not each.name.startswith(("common_", "help"))]
    if own:
        rows = [_parameter(each, context) for each in own]
        yield from ("| argument or option | what | default |", "|---|---|---|", *rows, "")


def _help(text: str) -> str:
    """Return the paragraphs of a help text; its last line, `Example: ...`, becomes code."""
    summary, _, example = text.replace("\b", "").partition("Example: ")
    return _paragraphs(summary) + (f"\n\n```console\n{example.strip()}\n```" if example else "")


def _parameter(each: Any, context: Any) -> str:
    is_argument = each.param_type_name == "argument"
    names = [each.make_metavar(context)] if is_argument else [*each.opts, *each.secondary_opts]
    shown = ", ".join(f"`{name}`" for name in names)
    is_default = isinstance(each.default, str | int | float) and not isinstance(each.default, bool)
    return f"| {shown} | {_cell(each.help or '')} | {f'`{each.default}`' if is_default else ''} |"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


def routes() -> str:
    """Each route of the HTTP interface, from its OpenAPI document."""
    document = json.loads(OPENAPI.read_text(encoding="utf-8"))
    lines = ["| method | path | what it does | takes |", "|---|---|---|---|"]
    for path, methods in document["paths"].items():
        for method, route in methods.items():
            summary = route.get("summary", "") if "description" not in route else route["description"]
            first = summary.strip().split("\n\n")[0]
            body = route.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema", {})
            taken = [f"`{each['name']}`" for each in route.get("parameters", []) if each["in"] == "query"]
            taken += [f"`{name}`" for name in _fields(body, document)]
            lines.append(f"| {method.upper()} | `{path}` | {_cell(first)} | {', '.join(taken)} |")
    return "\n".join(lines)


def _fields(schema: Any, document: Any) -> list[str]:
    if "$ref" in schema:
        schema = document["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    return list(schema.get("properties", {}))


def model_files() -> str:
    """The keys of a model file in both forms, and then those of its parts."""
    models: dict[str, Any] = {}
    for file in (PaperFile, ThermalFile):
        models |= file.model_json_schema()["$defs"]
    first = ("PaperFile", "ThermalFile")
    order = [*first, *sorted(name for name in models if name not in first)]
    shown = {"properties": {}, "$defs": {name: models[name] for name in order}}
    page = make_reference("", shown)
    return page[page.index("## ") :]


MADE: dict[str, Callable[[], str]] = {
    "steps": steps,
    "events": events,
    "stand_commands": stand_commands,
    "compensate_commands": compensate_commands,
    "routes": routes,
    "model_files": model_files,
}
