"""What an operator may order: one method of a stand's service with one typed argument.

    @command("/run/skip")
    async def skip(self, who: Requester, given: SkipRequest) -> str:
        "Leave a step out, or break it off."

From it follow the route and its OpenAPI (api/app.py), the verb of the command line (commands/verbs.py), the
command that is recorded (`perform`), SECoP's command of the module `run`, and the page's button (`GET
/api/v1/commands`).
"""

from __future__ import annotations

import inspect
import re
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import takewhile
from typing import Any, Literal, TypeVar, cast, get_type_hints

from pydantic import BaseModel, JsonValue

from thermostand.foundation.clock import Clock
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import StandError
from thermostand.foundation.events import COMMAND
from thermostand.foundation.hub import Hub
from thermostand.stand.config.interface_section import Role
from thermostand.stand.serving.api_models import (
    CommandAnswer,
    DeviceState,
    PlanCheck,
    PlanStep,
    Requester,
    RunPreview,
    RunRequest,
    SimulatedFaults,
    StandState,
    WrittenStep,
)

STOP = "stop"
_MARK = "__command__"
_LONGEST = 200  # characters of a text that an event has; a recipe has more, and is kept by its session

Method = TypeVar("Method", bound=Callable[..., object])
Http = Literal["POST", "PUT", "DELETE"]


@dataclass(frozen=True, slots=True)
class Typed:
    """How a field of an argument is typed on the command line: by this name, "" for not at all, `unit` of it being one
    there. value: it is a flag that stands for this value. is_first: an argument, though it has a default. text_in: the
    field that has the text of a file, where a file of that name is there."""

    name: str
    help: str = ""
    unit: float | None = None
    value: str | None = None
    is_first: bool = False
    text_in: str = ""


@dataclass(frozen=True, slots=True)
class _Mark:
    path: str
    http: Http
    status: int
    verbs: tuple[str, ...] | None
    title: str
    anywhere: bool
    by_secop: str | None
    role: Role | None


def command(
    path: str,
    *,
    http: Http = "POST",
    status: int = 200,
    verbs: tuple[str, ...] | None = None,
    title: str = "",
    anywhere: bool = False,
    by_secop: str | None = "",
    role: Role | None = "operate",
) -> Callable[[Method], Method]:
    """A method is a command, at this path below /api/v1, in which {name} is a field of its argument.

    It takes who asks and, if anything, one Document, and returns a sentence, for the CommandAnswer, or a value. It
    raises Conflict when the state forbids it, Missing, or ConfigError when the argument is wrong. verbs: of the command
    line, such as `queue move`; its name where none is given, () for none that only sends. title: what a button for it
    is called, its name where none is given. anywhere: its verb finds the only stand of this machine. by_secop: the
    field that SECoP's command takes, "" for the only one that is required, None for no such command.
    role: that it needs, None for nobody's.
    """

    def mark(method: Method) -> Method:
        setattr(method, _MARK, _Mark(path, http, status, verbs, title, anywhere, by_secop, role))
        return method

    return mark


@dataclass(frozen=True, slots=True)
class Command(_Mark):
    """name: as it is recorded. text: of its docstring. argument: None when it takes none."""

    name: str
    method: str
    text: str
    argument: type[Document] | None
    answer: type[BaseModel]

    @property
    def secop_field(self) -> str | None:
        """What SECoP's command takes, "" for nothing; None when there is none."""
        fields = {} if self.argument is None else self.argument.model_fields
        needed = [name for name, info in fields.items() if info.is_required()]
        return self.by_secop if self.by_secop or self.by_secop is None else _get_only(needed)

    @property
    def summary(self) -> str:
        """The first paragraph of its text, as one line."""
        return " ".join(takewhile(bool, self.text.splitlines()))

    @property
    def in_path(self) -> tuple[str, ...]:
        """The fields of its argument that stand in its path."""
        return tuple(re.findall(r"{(\w+)}", self.path))


def _get_only(names: Sequence[str]) -> str | None:
    return None if len(names) > 1 else "".join(names)


def collect_commands(service: type[Served]) -> dict[str, Command]:
    """Every command of a service, by name, those of its bases first."""
    marked: dict[str, tuple[Callable[..., object], _Mark]] = {}
    for each in reversed(service.__mro__):
        for name, method in vars(each).items():
            if isinstance(mark := getattr(method, _MARK, None), _Mark):
                marked[name] = method, mark
    return {each.name: each for each in (_make_command(name, *found) for name, found in marked.items())}


def _make_command(method_name: str, method: Callable[..., object], mark: _Mark) -> Command:
    hints = get_type_hints(method)
    answer = hints.pop("return")
    argument = [hint for hint in hints.values() if hint is not Requester]
    name = method_name.rstrip("_")
    title, verbs = mark.title or name.replace("_", " ").capitalize(), (name,) if mark.verbs is None else mark.verbs
    return Command(
        **asdict(replace(mark, title=title, verbs=verbs)),
        name=name,
        method=method_name,
        text=inspect.getdoc(method) or "",
        argument=cast("type[Document]", argument[0]) if argument else None,
        answer=CommandAnswer if answer is str else cast("type[BaseModel]", answer),
    )


class Served(ABC):
    """What clients see of a stand. All of it is called on the control loop and returns quickly: no method waits for a
    wire, and what waits for a disk is `async` and stands in nobody's way."""

    def __init__(self, hub: Hub, clock: Clock) -> None:
        self.hub = hub
        self.clock = clock
        self.commands = collect_commands(type(self))

    @abstractmethod
    def state(self) -> StandState:
        """The state as it is now."""

    @abstractmethod
    def plan(self) -> tuple[PlanStep, ...]:
        """The plan in force; empty when nothing is run. With `check_edit` what any thread may call: a long plan takes a
        while, so it reads values only that are replaced and never changed."""

    @abstractmethod
    def check_edit(self, from_index: int, steps: Sequence[WrittenStep]) -> PlanCheck:
        """Return what the command `edit` would say; changes nothing. Any thread may call it. Conflict when nothing is
        run."""

    @abstractmethod
    async def preview(self, request: RunRequest) -> RunPreview:
        """Return what a recipe would do on this stand now; queues nothing. Conflict where no queue is kept."""

    @abstractmethod
    def devices(self) -> tuple[DeviceState, ...]:
        """The commands that devices take by hand."""

    @abstractmethod
    async def list_simulated_faults(self) -> SimulatedFaults:
        """Return what can be broken on purpose; Conflict when the stand is no simulated one."""

    @abstractmethod
    def make_answer(self, verb: str, text: str) -> CommandAnswer:
        """The answer to a command of which that sentence came."""

    def find_role(self, name: str, given: Document | None) -> Role | None:
        """Which role a command needs with that argument; None for nobody's."""
        return self.commands[name].role

    def perform(self, name: str, who: Requester, given: Document | None = None) -> BaseModel | Awaitable[BaseModel]:
        """Do a command, and record who asked for it and what came of it; raises what it raises. One that awaits
        nothing, as STOP, is done when this returns."""
        found = self.commands[name]
        try:
            if (role := self.find_role(name, given)) is not None:
                who.require(role, describe_command(name, summarize_argument(given)))
            came = getattr(self, found.method)(who, *(() if found.argument is None else (given,)))
        except StandError as error:
            self.publish_command(who, name, given, f"refused: {error}")
            raise
        if inspect.isawaitable(came):
            return self._complete(who, name, given, came)
        return self._record_result(who, name, given, came)

    async def _complete(self, who: Requester, name: str, given: Document | None, work: Awaitable[Any]) -> BaseModel:
        try:
            came = await work
        except StandError as error:
            self.publish_command(who, name, given, f"refused: {error}")
            raise
        return self._record_result(who, name, given, came)

    def _record_result(self, who: Requester, name: str, given: Document | None, came: object) -> BaseModel:
        self.publish_command(who, name, given)
        return self.make_answer(name, came) if isinstance(came, str) else cast("BaseModel", came)

    def publish_command(self, who: Requester, name: str, given: Document | None, result: str = "done") -> None:
        """The event of a command: who, how, what, and what came of it."""
        arguments = summarize_argument(given)
        data = {"who": who.name, "how": who.how, "verb": name, "arguments": arguments, "result": result}
        self.hub.publish(COMMAND.at(self.clock.now_ns(), describe_command(name, arguments), **data))


def summarize_argument(given: Document | None) -> dict[str, JsonValue]:
    """Return what an event has of an argument: no long text, of steps how many there are, nothing that is empty, and no
    flag that was not set."""
    if given is None:
        return {}
    values = given.model_dump(mode="json")
    found = {name: len(value) if name == "steps" else value for name, value in values.items()}
    unset = {name for name, info in type(given).model_fields.items() if info.default is False and not values[name]}
    return {name: value for name, value in found.items() if name not in unset and not _is_left_out(value)}


def _is_left_out(value: object) -> bool:
    return value is None or value in ("", [], {}) or (isinstance(value, str) and len(value) > _LONGEST)


def describe_command(verb: str, arguments: Mapping[str, JsonValue]) -> str:
    """`pause when=now`, `skip step_id=0-soak`, `flap open`, `linear move position=12.0`."""
    if verb == "device":
        given = arguments.get("arguments")
        pairs = _format_pairs(given) if isinstance(given, Mapping) else []
        return " ".join([str(arguments.get("device")), str(arguments.get("verb")), *pairs])
    return " ".join([verb, *_format_pairs({name: value for name, value in arguments.items() if name != "key"})])


def _format_pairs(arguments: Mapping[str, JsonValue]) -> list[str]:
    return [f"{name}={value}" for name, value in arguments.items() if value not in ("", [], None)]
