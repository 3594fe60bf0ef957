"""What the steps of a plan are, and the order that every plan keeps."""

from hypothesis import strategies as st

from thermostand.experiments.steps import (
    Capture,
    CheckHome,
    CloseFlap,
    CoolDown,
    MoveTo,
    OpenFlap,
    PowerCamera,
    Prompt,
    Role,
    SetTemperature,
    Soak,
    SoakUntilSettled,
    StartChamber,
    Step,
    StopChamber,
    number_steps,
)

GRID = {"linear_mm": (0.0, 100.0), "rotary_deg": (-10.0, 0.0, 10.0)}
POSITIONS = ({"linear_mm": 70.0, "rotary_deg": 0.0}, {"linear_mm": 95.0, "rotary_deg": 8.0})
PLACES = {"temperatures_degC": (24.0, 30.0, 12.0), "positions": POSITIONS}


def captures(steps: list[Step], *roles: Role) -> list[Capture]:
    return [step for step in steps if isinstance(step, Capture) and step.role in roles]


def table_positions(steps: list[Step], role: Role) -> list[tuple[float, float]]:
    """(linear mm, rotary deg) at each capture of the role."""
    table: dict[str, float] = {}
    found: list[tuple[float, float]] = []
    for step in steps:
        match step:
            case MoveTo(axis, position):
                table[axis] = position
            case Capture() if step.role is role:
                found.append((table["linear"], table["rotary"]))
            case _:
                pass
    return found


def check_order(steps: list[Step]) -> None:
    """Flap open for captures only (and the camera's start before one); chamber running and at rest at each capture; a
    camera that cools is off, one that captures on; nothing is left running at the end."""
    flap_open, camera_on, chamber_degC, settled = False, True, None, False
    for before, step in zip([None, *steps], steps, strict=False):
        match step:
            case OpenFlap():
                flap_open = True
            case CloseFlap():
                flap_open = False
            case PowerCamera(on):
                camera_on = on
                assert not on or flap_open, "nothing may come between the camera's start and its first frame"
            case StartChamber(set_point_degC) | SetTemperature(set_point_degC):
                chamber_degC, settled = set_point_degC, False
            case StopChamber():
                chamber_degC = None
            case CoolDown():
                assert not camera_on
                assert chamber_degC is not None
                assert not flap_open
                settled = True
            case Soak() | SoakUntilSettled():
                assert isinstance(step, Soak) or step.chamber_degC == chamber_degC
                assert camera_on
                assert not flap_open
                settled = True
            case Capture():
                assert flap_open
                assert camera_on
                assert settled
                assert step.chamber_degC == chamber_degC
                assert isinstance(before, OpenFlap | PowerCamera)
            case MoveTo() | CheckHome():
                assert not flap_open
            case Prompt():
                assert chamber_degC is None
                assert not camera_on
    assert (flap_open, chamber_degC, camera_on) == (False, None, True)


def check_ids(steps: list[Step]) -> None:
    ids = [planned.step_id for planned in number_steps(steps)]
    assert ids == [planned.step_id for planned in number_steps(steps)]
    assert len(set(ids)) == len(ids)


lengths = st.floats(0, 280)
angles = st.floats(-40, 40)
places = st.lists(st.tuples(lengths, angles), min_size=2, max_size=6, unique=True).map(
    lambda pairs: [{"linear_mm": linear, "rotary_deg": rotary} for linear, rotary in pairs]
)
