"""What the experiments' parameters have in common: the chamber's range, waits that end, and how frames are taken."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, Self, cast

from pydantic import BeforeValidator, Field, model_validator

from thermostand.foundation.documents import Document

OnUnsettled = Literal["mark", "hold"]
WantedState = Literal["at_rest", "on_the_way"]
WANTED_STATES: tuple[WantedState, ...] = ("at_rest",)
# Ten digits of a regulator's display. A chamber that is too weak for it still gives frames, which are marked.
SOAK_BAND_K = 1.0
COLDEST_degC, WARMEST_degC = -10.0, 70.0  # the paper's chamber, section 2
_SHORTEST_DWELL_s = 60.0  # shorter is a slip of the unit; not measured
Chamber_degC = Annotated[float, Field(ge=COLDEST_degC, le=WARMEST_degC)]
Wait_s = Annotated[float, Field(ge=0, le=7 * 86400)]  # longer is a slip of the keyboard
FrameCount = Annotated[int, Field(ge=1, le=1_000_000)]
Linear_mm = Annotated[float, Field(ge=-300, le=300)]  # the linear table's travel is 300 mm
Rotary_deg = Annotated[float, Field(ge=-360, le=360)]


class CaptureParameters(Document):
    """How every experiment takes its frames."""

    interval_s: float = Field(default=0.5, gt=0, le=86400, description="From one frame to the next.")
    exposure_s: float = Field(default=0.1, gt=0, le=10, description="Exposure of each frame.")

    @model_validator(mode="after")
    def _check_exposure(self) -> Self:
        if self.exposure_s > self.interval_s:
            raise ValueError(f"exposure_s {self.exposure_s} does not fit into interval_s {self.interval_s}")
        return self


class Guaranteed(Document):
    """How near to its set-point the chamber has to be before frames are taken there; see steps.Soak."""

    band_K: float = Field(
        default=SOAK_BAND_K,
        ge=0,
        le=20,
        description="How near to the set-point the air has to stay in a soak's last part.",
    )
    unsettled: OnUnsettled = Field(
        default="mark",
        description="When a soak's longest time is over outside the band: mark the frames, or hold the run.",
    )


class StillTable(CaptureParameters):
    """An experiment with the target in one place: axis -> mm or deg."""

    table_position: dict[str, float] = Field(
        default_factory=dict, description="Where each axis of the table holds the target."
    )


class Settled(Document):
    """When a camera counts as settled; see steps.SoakUntilSettled.

    The drift decides: it is seen to some 0.1 mpx/min, while cameras give their temperature in digits of 0.1 to 0.5 K.
    """

    min_s: Wait_s = Field(default=600.0, description="The shortest soak.")
    window_s: float = Field(default=600.0, ge=60, le=3600, description="The time over which the rates are judged.")
    # The flap alone takes 6 s there and back.
    look_every_s: float = Field(default=120.0, ge=20, le=900, description="From one look at the target to the next.")
    # On 10 drawn cameras these rates save 10 % of the soaks in the median (0 to 46), twice the rates 34 %, and the
    # thermal form leaves 1.00 and 1.25 times what it does after full soaks (2.6 and 4.3 in the worst): a slow part
    # moves less than noise.
    camera_K_per_min: float = Field(
        default=0.2, gt=0, le=10, description="The camera is settled when its temperature changes no faster."
    )
    drift_px_per_min: float = Field(
        default=0.003, gt=0, le=10, description="The image is settled when it drifts no faster."
    )

    @model_validator(mode="after")
    def _check_looks(self) -> Self:
        if self.window_s < 4 * self.look_every_s:
            raise ValueError(f"window_s {self.window_s} holds less than four looks every {self.look_every_s} s")
        return self


class Known(Document):
    """Experimental: when enough is known of a camera, and within what the run decides; see steps.Decide.

    states: those in which the model is wanted, throughout the range of the set-points: of a camera at rest, 4 h after a
    change, or on the way, 45 min after it. wait_s: for a decision, in real time.
    """

    residual_px: float = Field(default=0.005, gt=0, le=10)
    # Longer ones (1500 to 5400 s) were better at rest after 45 %, but so few set-points were visited that a cycle never
    # ended.
    soaks_s: tuple[Wait_s, ...] = Field(default=(900.0, 1500.0, 2700.0), min_length=1, max_length=5)
    ramp_K_per_min: float = Field(default=2.0, gt=0, le=20)
    states: tuple[WantedState, ...] = Field(default=WANTED_STATES, min_length=1, max_length=2)
    wait_s: float = Field(default=120.0, ge=5, le=3600)

    @model_validator(mode="after")
    def _check_dwells(self) -> Self:
        if min(self.soaks_s) < _SHORTEST_DWELL_s:
            raise ValueError(f"soaks_s has {min(self.soaks_s)}; a visit takes at least {_SHORTEST_DWELL_s:g} s")
        return self


def _expand_settled(value: object) -> object:
    """`settled` alone takes the defaults, `{settled: {...}}` has some of its own."""
    return _expand_either(value, {"settled": Settled})


def _expand_settled_or_known(value: object) -> object:
    return _expand_either(value, {"settled": Settled, "known": Known})


def _expand_either(value: object, kinds: Mapping[str, type[Settled | Known]]) -> object:
    if isinstance(value, str) and value in kinds:
        return kinds[value]()
    if isinstance(value, dict) and len(cast("dict[object, object]", value)) == 1:
        ((name, given),) = cast("dict[object, object]", value).items()
        if name in kinds:
            return kinds[str(name)].model_validate(given)
    if value is None or isinstance(value, tuple(kinds.values())):
        return value
    names = " or ".join(f"`{name}`" for name in kinds)
    raise ValueError(f"until takes {names}, alone or with thresholds behind a colon, not {value!r}")


class _UntilSettled(Document):
    """The thresholds as a recipe writes them."""

    settled: Settled


Until = Annotated[
    Settled | None, BeforeValidator(_expand_settled, json_schema_input_type=_UntilSettled | Literal["settled"])
]


class _UntilKnown(Document):
    """The condition as a recipe writes it."""

    known: Known


UntilSettledOrKnown = Annotated[
    Settled | Known | None,
    BeforeValidator(
        _expand_settled_or_known,
        json_schema_input_type=_UntilSettled | _UntilKnown | Literal["settled"] | Literal["known"],
    ),
]


def check_until(until: Settled | None, soak_s: float, name: str = "soak_s") -> None:
    """ValueError when a dwell of at most `soak_s`, by that name, leaves no time to see that the camera has settled."""
    if until is not None and soak_s < max(until.min_s, until.window_s):
        raise ValueError(
            f"{name} {soak_s} is the longest dwell; it must be at least until's min_s {until.min_s} "
            f"and window_s {until.window_s}"
        )


class TablePosition(Document):
    """Where the table holds the target."""

    linear_mm: Linear_mm
    rotary_deg: Rotary_deg


class MovingTable(CaptureParameters):
    """An experiment that moves the target; `settle_s` after each move the table has stopped ringing."""

    settle_s: Wait_s = Field(default=5.0, description="After each move, until the table is at rest.")
    frames_per_position: FrameCount = Field(default=5, description="Frames at each position.")
