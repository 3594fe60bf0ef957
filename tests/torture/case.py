"""A case of the torture rig: a stand, a plan, faults, orders and kills. Drawn from a seed, or read from a YAML."""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from thermostand.drivers.sim.laboratory_faults import FAULTS

START_NS = 1_767_290_400_000_000_000  # 2026-01-01 18:00 UTC, as the installed simulated stand has it
LASTS_S = (5.0, 20.0, 60.0, 300.0, 1800.0)  # of faults
MOST_FAULTS, MOST_ORDERS, MOST_KILLS = 8, 6, 3
LEFT_OUT = 0.5  # of the kinds, in each seed: what one kind hides of another shows then


@dataclass(frozen=True, slots=True)
class Fault:
    """One of the simulator's (`stand simulate --faults`), from at_s after the begin on, for for_s."""

    name: str
    value: Any
    at_s: float
    for_s: float


@dataclass(frozen=True, slots=True)
class Order:
    """What somebody does at at_s: `verb` is one of ORDERS."""

    verb: str
    at_s: float
    body: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Case:
    """stand: the choice at each place of tests.system.test_stand_combinations.PLACES. plan: a recipe's steps or
    experiments. kills_s: when the program is killed; each time its run is resumed. drawn_order: sleepers with one
    deadline, and tasks ready at one wake, run in an order drawn from the seed. is_real: in real time, see real.py.
    start_ns: the instant from which its seconds count. settings: of sections of the stand's file, beside
    the usual ones."""

    seed: int
    stand: dict[str, str]
    plan: dict[str, list[Any]]
    chamber_seed: int | None = None
    laboratory_degC: float = 24.0
    attended: bool = False
    drawn_order: bool = True
    faults: tuple[Fault, ...] = ()
    orders: tuple[Order, ...] = ()
    kills_s: tuple[float, ...] = ()
    is_real: bool = False
    start_ns: int = START_NS
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)


PLAIN = {
    "heat": "omron-e5cc",
    "relays": "waveshare",
    "flap": "flap",
    "axes": "two axes",
    "thermometers": "5",
    "cameras": "1 camera",
    "extras": "alone",
}


def steps_of(plan: dict[str, list[Any]]) -> int:
    """How many entries a plan has."""
    return sum(map(len, plan.values()))


def write_case(case: Case) -> str:
    """As YAML, without what is as usual; a line for each fault and order."""
    usual = asdict(Case(case.seed, case.stand, case.plan))
    data = {name: value for name, value in asdict(case).items() if name in ("stand", "plan") or value != usual[name]}
    data = {"seed": case.seed, **json.loads(json.dumps(data))}
    for order in data.get("orders", ()):
        if not order["body"]:
            del order["body"]
    return yaml.safe_dump(data, sort_keys=False, width=140, default_flow_style=None)


def read_case(path: Path) -> Case:
    """From YAML."""
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    data["faults"] = tuple(Fault(**each) for each in data.get("faults", ()))
    data["orders"] = tuple(Order(**each) for each in data.get("orders", ()))
    data["kills_s"] = tuple(data.get("kills_s", ()))
    return Case(**data)


CHAMBERS = ("espec", "cts", "ascii2", "simserv", "julabo")
# Which faults a stand can have: by the beginning of their name, whether it has that.
_HAS: dict[str, Callable[[dict[str, str]], bool]] = {
    "bus": lambda stand: True,
    "heater": lambda stand: True,
    "chamber": lambda stand: stand["heat"] in CHAMBERS,
    "regulator": lambda stand: stand["heat"] == "omron-e5cc",
    "heat_module": lambda stand: stand["heat"] == "heat module",
    "relays": lambda stand: stand["heat"] not in CHAMBERS or stand["relays"] != "no board",
    "inputs": lambda stand: stand["extras"] != "alone",
    "imager": lambda stand: stand["extras"] != "alone",
    "flap": lambda stand: stand["flap"] == "flap",
    "camera": lambda stand: stand["cameras"] != "no camera",
    "axis": lambda stand: stand["axes"] != "no axes",
    "linear": lambda stand: stand["axes"] != "no axes",
    "rotary": lambda stand: stand["axes"] != "no axes",
    "thermometer": lambda stand: stand["thermometers"] != "16",
    "thermometers": lambda stand: stand["thermometers"] != "16",
    "ups": lambda stand: False,  # no drawn stand has one: a UPS that is told to end runs would hide what else is wrong
}
# What happens in real time on a wire or at a camera races with the program: such a seed would not repeat.
_RACES = {
    "delay_s",
    "late",
    "late_s",
    "mixed",
    "pending",
    "stretch_s",
    "leader_early_s",
    "unpaced",
    "reordered",
    "loss",
}
RACES = {name for name in FAULTS if name.partition(".")[2] in _RACES} | {
    "camera.truncated",
    "camera.burst",
    "flap.timeout",
}
KINDS = {name: fault.worst for name, fault in sorted(FAULTS.items()) if name not in RACES}
"""The faults of virtual time, and how bad each is at worst: a new one of the simulator's is drawn by itself."""
# A contact that always conducts, or a board without its timer, leaves nothing that software could cut: one at a time,
# and not together with a heater that conducts by itself. The hard-wired cut-out is for that.
BEYOND = ("relays.welded", "relays.no_timer", "relays.no_rearm", "relays.lost_writes", "heater.welded_share")
_TIMES_OUT = ("silent", "unplugged", "mute", "silent_s", "swallows_first", "compoway", "hangs_up")
_NAMES = {"5": ("air", "granite_inside", "granite_outside", "artifact", "laboratory"), "2": ("air", "granite_inside")}
ORDERS = (
    *("pause", "continue", "reset", "stop", "note", "skip", "extend", "interrupt", "state"),
    *("switch_on", "switch_off", "lose_folder", "fill_disk", "refuse_writes"),
)
"""The operator's commands over HTTP, two signals, a second client's look, a second master that writes coils, and what
happens to the disk of the session."""
UNDONE = {
    "pause": ("continue",),
    "lose_folder": ("find_folder", "reset"),
    "fill_disk": ("empty_disk", "reset"),
    "refuse_writes": ("take_writes",),
}
"""What follows on an order, some time later."""


CYCLES = 0.15  # of the seeds, as far as their stand has one camera


def draw(seed: int) -> Case:
    """The case of a seed."""
    drawn = random.Random(seed)
    stand = draw_stand(drawn)
    plan, duration_s = _cycle(random.Random(f"cycle {seed}"), stand) or _plan(drawn, stand)
    left = {kind for kind in (*KINDS, *ORDERS, "kill") if drawn.random() >= LEFT_OUT}
    return Case(
        seed,
        stand,
        plan,
        chamber_seed=drawn.choice((None, drawn.randrange(1000))),
        laboratory_degC=drawn.choice((24.0, 18.0, 30.0)),
        attended=drawn.random() < 0.3,
        faults=tuple(draw_faults(drawn, stand, left & KINDS.keys(), duration_s, LASTS_S, MOST_FAULTS)),
        orders=tuple(_orders(drawn, left, duration_s)),
        kills_s=_kills(drawn, left, duration_s),
        settings=_settings(random.Random(f"settings {seed}"), stand),
    )


def _settings(drawn: random.Random, stand: dict[str, str]) -> dict[str, dict[str, Any]]:
    """Those without which some rules and events are out of a drawn case's reach."""
    wet = {"dew": {"humidity_percent": 70}} if stand["thermometers"] == "5" else {}
    guard = drawn.choice(({}, {"disk_low_s": 60.0}, {"pause_limit_h": 0.1}, {"flap_open_s": 60.0}))
    settings = {"guard": guard, "ending": drawn.choice(({}, {"to_ambient": True, "max_s": 1800.0}))}
    return {name: values for name, values in (settings | drawn.choice(({}, wet))).items() if values}


def draw_stand(drawn: random.Random) -> dict[str, str]:
    from tests.system.test_stand_combinations import NOT_SIMULATED, PLACES

    names = {place: [each.name for each in choices] for place, choices in PLACES.items()}
    names["heat"] = [name for name in names["heat"] if name not in NOT_SIMULATED]
    return {place: drawn.choice((PLAIN[place], drawn.choice(names[place]))) for place in PLACES}


def _cycle(drawn: random.Random, stand: dict[str, str]) -> tuple[dict[str, list[Any]], float] | None:
    """For some seeds the paper's cycle, to which the drift can be fitted, and about how long it takes, s."""
    if drawn.random() > CYCLES or stand["cameras"] != "1 camera":
        return None
    points, soak_s = drawn.sample(range(26, 46, 3), drawn.randint(3, 5)), drawn.choice((600, 1500))
    cycle = {"set_points_degC": points, "soak_s": soak_s, "equilibrium_s": soak_s, "reference_frames": 3}
    cycle["frames_per_point"] = drawn.choice((1, 2))
    return {"experiments": [{"thermal_cycle": cycle}]}, 900.0 + (len(points) + 1) * (soak_s + 180.0)


def _plan(drawn: random.Random, stand: dict[str, str]) -> tuple[dict[str, list[Any]], float]:
    """A recipe, and about how long it takes, s."""
    low = 12 if stand["relays"] != "no compressor" or stand["heat"] in CHAMBERS else 26
    has_table, has_camera = stand["axes"] == "two axes", stand["cameras"] != "no camera"
    if has_table and has_camera and drawn.random() < 0.25:
        soak_s = drawn.choice((300, 600, 900))
        if drawn.random() < 0.5:
            grid = {"linear_mm": [0, 40], "rotary_deg": [-5, 5], "frames_per_position": 1, "equilibrium_s": soak_s}
            return {"experiments": [{"calibration": grid}]}, 900.0 + soak_s
        spots = [{"linear_mm": 0, "rotary_deg": 0}, {"linear_mm": 40, "rotary_deg": 5}]
        points = {"temperatures_degC": [24, drawn.randrange(low, 42) + 0.5], "positions": spots, "soak_s": soak_s}
        points |= {"equilibrium_s": soak_s, "reference_frames": 1, "frames_per_position": 1}
        return {"experiments": [{"validation": points}]}, 1500.0 + 2 * soak_s
    soaks_s = drawn.choice(((120, 300, 600), (600, 1800, 3000)))  # a short plan finds most of what a long one does
    steps: list[Any] = ["close_flap", {"start_chamber": 26}, {"soak": soaks_s[0]}]
    duration_s = 150.0 + soaks_s[0]
    for _ in range(drawn.randint(1, 4)):
        soak_s = drawn.choice(soaks_s)
        settles = has_camera and soak_s >= 1800 and drawn.random() < 0.5
        steps += [{"set_temperature": drawn.randrange(low, 46)}]
        steps += [{"soak_until_settled": {"max_s": soak_s}} if settles else {"soak": soak_s}]
        if has_table and drawn.random() < 0.5:
            steps += [{"move_to": {"linear": drawn.choice((0, 20, 60)), "rotary": drawn.choice((-5, 0, 5))}}]
        interval_s, role = drawn.choice((1, 20)), drawn.choice(("fit", "other"))
        capture = {"capture": {"frames": drawn.randint(1, 3), "interval_s": interval_s, "role": role}}
        steps += ["open_flap", capture if has_camera else {"soak": 30}, "close_flap"]
        steps += [{"prompt": "turn the target"}] if drawn.random() < 0.2 else []
        duration_s += soak_s + 120.0
    return {"steps": [*steps, "stop_chamber"]}, duration_s


def draw_faults(
    drawn: random.Random,
    stand: dict[str, str],
    kinds: Iterable[str],
    within_s: float,
    lasts_s: tuple[float, ...],
    most: int,
) -> Iterator[Fault]:
    """At most so many of these kinds that such a stand can have, each for one of these times."""
    names = [name for name in sorted(kinds) if _HAS[name.partition(".")[0]](stand)]
    is_beyond = False
    for name in drawn.choices(names, k=drawn.randrange(most + 1)) if names else ():
        if name in BEYOND and is_beyond:
            continue
        is_beyond = is_beyond or name in BEYOND
        for_s = drawn.choice(lasts_s)
        if name.partition(".")[2] in _TIMES_OUT:
            for_s = min(for_s, 20.0)  # each time-out takes real time
        yield Fault(name, _value(drawn, name, stand), round(drawn.uniform(0.0, within_s), 1), for_s)


def _value(drawn: random.Random, name: str, stand: dict[str, str]) -> Any:
    worst, names = FAULTS[name].worst, _NAMES.get(stand["thermometers"], ("air",))
    match name:
        case "inputs.changed":
            return "door"
        case "axis.alarm":
            return drawn.choice(("linear", "rotary"))
        case "relays.welded":
            return drawn.choice(("heater_enable", "compressor")[: 1 + (stand["relays"] != "no compressor")])
        case "heater.welded_share":
            return drawn.choice((0.1, 0.3, 1.0))
        case _ if isinstance(worst, dict):
            share = drawn.choice((1.0, 0.3, -1.0))
            return {drawn.choice(names): 24.0 if name.endswith("_degC") else share * float(*worst.values())}
        case _ if name.startswith("thermometer."):
            return drawn.choice(names)
        case _ if isinstance(worst, float):
            return round(worst * drawn.choice((1.0, 0.5)), 3)
        case _:
            return copy.deepcopy(list(worst) if isinstance(worst, tuple) else worst)


def _orders(drawn: random.Random, left: set[str], duration_s: float) -> Iterator[Order]:
    verbs = [verb for verb in ORDERS if verb in left]
    if not verbs or drawn.random() < 0.4:
        return
    for verb in drawn.choices(verbs, k=drawn.randint(1, MOST_ORDERS)):
        at_s = round(drawn.uniform(0.0, duration_s), 1)
        yield Order(verb, at_s, {"relay": drawn.choice((0, 1, 3))} if verb.startswith("switch") else {})
        after_s = drawn.choice((10.0, 300.0, 1200.0))
        yield from (Order(each, round(at_s + after_s + number, 1)) for number, each in enumerate(UNDONE.get(verb, ())))


def _kills(drawn: random.Random, left: set[str], duration_s: float) -> tuple[float, ...]:
    if "kill" not in left or drawn.random() < 0.5:
        return ()
    return tuple(sorted(round(drawn.uniform(0.0, duration_s), 2) for _ in range(drawn.randint(1, MOST_KILLS))))


def stand_document(case: Case, folder: Path) -> dict[str, Any]:
    """The stand's file; what it needs beside it is written to `folder`."""
    from tests.system.test_stand_combinations import PLACES, written

    parts = [next(each for each in PLACES[place] if each.name == name) for place, name in case.stand.items()]
    data = written(tuple(parts), folder)
    data["bus"] |= {"timeout_s": 0.05}  # real time, of which a silent unit takes most
    for device in (data.get("climate_chamber", {}), *data.get("probes", {}).values()):
        device |= {"timeout_s": 0.1}
    laboratory = {"chamber_seed": case.chamber_seed, "laboratory_degC": case.laboratory_degC, "seed": case.seed}
    data["simulation"] |= laboratory
    if "imager" in data:
        data["imager"]["folder"] = str(folder / "pictures")
    for section, values in case.settings.items():
        data[section] = {**data.get(section, {}), **values}
    return data


_PLAINER = {"drawn_order": False, "chamber_seed": None, "attended": False, "laboratory_degC": 24.0, "settings": {}}


def smaller(case: Case) -> Iterator[tuple[str, Case]]:
    """What a failing case could be instead, the boldest first; of each what is left out or plainer, in words that are
    the same for a case that has become smaller elsewhere."""
    yield "nothing happens", replace(case, faults=(), orders=(), kills_s=())
    for name in ("kills_s", "orders", "faults"):
        whole: tuple[Any, ...] = getattr(case, name)
        if whole:
            yield f"no {name}", replace(case, **{name: ()})
        half = len(whole) // 2
        for part in (whole[:half], whole[half:]) if half > 1 else ():
            yield f"without {part}", replace(case, **{name: tuple(each for each in whole if each not in part)})
        for each in whole if len(whole) > 1 else ():
            yield f"without {each}", replace(case, **{name: tuple(other for other in whole if other != each)})
    yield "as usual", replace(case, **_PLAINER)
    yield "a plain stand", replace(case, stand=PLAIN)
    for plan in _shorter(case.plan.get("steps", [])):
        yield f"the plan {plan}", replace(case, plan=plan)
    for place, choice in case.stand.items():
        if choice != PLAIN[place]:
            yield f"plain {place}", replace(case, stand={**case.stand, place: PLAIN[place]})
    for name, plain in _PLAINER.items():
        yield f"{name} as usual", replace(case, **{name: plain})
    for number, fault in enumerate(case.faults):
        if fault.for_s > 20.0:
            shorter = replace(fault, for_s=round(fault.for_s / 4, 1))
            yield f"shorter {fault}", replace(case, faults=(*case.faults[:number], shorter, *case.faults[number + 1 :]))


def _shorter(steps: list[Any]) -> Iterable[dict[str, list[Any]]]:
    """The plan without a half of its middle, then without one step of it."""
    middle = len(steps) // 2
    for first, last in ((3, middle), (middle, len(steps) - 1)):
        if 0 < last - first < len(steps) - 4:
            yield {"steps": [*steps[:first], *steps[last:]]}
    for number in range(1, len(steps) - 1):
        yield {"steps": [*steps[:number], *steps[number + 1 :]]}
