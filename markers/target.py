"""The calibration target: what is printed on it and in which order its markers are numbered.

Object frame: X to the right along the rows, Y up along the columns, mm, origin at marker 1. Marker 1 is bottom left;
numbering runs along a row, then up. Arrays hold marker n at index n - 1.

    square              staggered
    7  8  9             7  8  9
    4  5  6              4  5  6
    1  2  3             1  2  3
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from thermostand.foundation.documents import Document, load_document

# A print is off by hundredths of a pitch, a wrong order by a whole one. Round number; nothing was measured.
_CMM_TOLERANCE = 0.25
"""A measured centre further than this part of the pitch from its nominal place means a wrong order or a wrong unit."""

_LEAST_HOLE, _GREATEST_HOLE = 0.3, 0.7
"""Of the diameter: a smaller hole is not seen in a small image, a larger one leaves too little of the disc."""

Positive = Annotated[float, Field(gt=0)]
Number = Annotated[int, Field(ge=1)]


class OddMarker(Document):
    """The one marker printed in another size, which shows which way up the target is."""

    number: Number
    diameter_mm: Positive


class DonutMarkers(Document):
    """Three markers with a hole of the ground's colour in their middle, which show which way up the target is, and
    whether its image is mirrored."""

    numbers: tuple[Number, Number, Number]
    hole_mm: Positive


class Target(Document):
    """A grid of round markers, read from configs/targets/*.yaml.

    layout: in a staggered grid (OpenCV's asymmetric one) every second row is half a pitch further to the right, and
    rows are half a pitch apart. columns: markers in a row; the long side of a square grid. pitch_mm: between
    neighbours in a row. polarity: discs darker or lighter than the ground. cmm_mm: measured centres (X, Y) in mm,
    marker 1 first, in the object frame. cmm_uncertainty_mm, printing_error_mm: standard uncertainty of a measured and
    of a nominal coordinate; flatness_mm: of a marker's height above the plane. nominal_roll_deg: counter-clockwise
    angle of the rows in the image as the target is mounted; decides between the orientations a symmetrical grid leaves
    open; odd_marker or donut_markers settle it. minimum_markers: identification is refused below this count (default
    three quarters of the markers).
    certificate: what states its measured centres, in words; recorded with each session.
    """

    name: str
    layout: Literal["square", "staggered"] = "square"
    columns: Annotated[int, Field(ge=3)]
    rows: Annotated[int, Field(ge=3)]
    pitch_mm: Positive
    diameter_mm: Positive
    polarity: Literal["dark", "light"] = "dark"
    nominal_roll_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    odd_marker: OddMarker | None = None
    donut_markers: DonutMarkers | None = None
    minimum_markers: Annotated[int, Field(ge=6)] | None = None
    cmm_mm: tuple[tuple[float, float], ...] | None = None
    cmm_uncertainty_mm: Positive = 0.001
    printing_error_mm: Positive = 0.02
    flatness_mm: Positive = 0.005
    certificate: str = ""

    @model_validator(mode="before")
    @classmethod
    def _refuse_corner_boards(cls, given: object) -> object:
        if isinstance(given, dict) and "kind" in given:
            raise ValueError(
                f"kind: {given['kind']} is a board of squares or tags, which `compensate calibrate-photographs` and "
                "`calibrate-rig` take; here it must be a target of round markers"
            )
        return given

    @model_validator(mode="after")
    def _check_consistent(self) -> Target:
        if self.layout == "square" and self.columns < self.rows:
            raise ValueError(f"columns is the long side, found {self.columns} columns and {self.rows} rows")
        if self.diameter_mm >= self.spacing_mm:
            raise ValueError(f"discs of {self.diameter_mm} mm overlap at a pitch of {self.pitch_mm} mm")
        if self.odd_marker is not None:
            self._check_odd_marker(self.odd_marker)
        if self.donut_markers is not None:
            self._check_donut_markers(self.donut_markers)
        if self.minimum_markers is not None and self.minimum_markers > self.count:
            raise ValueError(f"minimum_markers is {self.minimum_markers}, but the target has {self.count}")
        if self.cmm_mm is not None:
            self._check_cmm(self.cmm_mm)
        return self

    def _check_odd_marker(self, odd: OddMarker) -> None:
        if odd.number > self.count:
            raise ValueError(f"odd_marker.number is {odd.number}, but the target has {self.count} markers")
        ratio = odd.diameter_mm / self.diameter_mm
        # Beyond these the areas differ by more than the factor of 1.6 within which spots count as alike (bootstrap.py).
        if 0.75 < ratio < 1.33:
            raise ValueError(f"odd_marker.diameter_mm differs too little from diameter_mm (ratio {ratio:.2f})")
        if odd.diameter_mm + self.diameter_mm >= 2 * self.spacing_mm:
            raise ValueError(f"the odd marker of {odd.diameter_mm} mm overlaps its neighbours")

    def _check_donut_markers(self, donuts: DonutMarkers) -> None:
        if self.odd_marker is not None:
            raise ValueError("odd_marker and donut_markers both say which way up the target is: give one of them")
        if max(donuts.numbers) > self.count or len(set(donuts.numbers)) < len(donuts.numbers):
            raise ValueError(f"donut_markers.numbers are three different ones of 1..{self.count}")
        if not _LEAST_HOLE <= donuts.hole_mm / self.diameter_mm <= _GREATEST_HOLE:
            raise ValueError(
                f"donut_markers.hole_mm is {_LEAST_HOLE:g} to {_GREATEST_HOLE:g} of diameter_mm, not "
                f"{donuts.hole_mm / self.diameter_mm:.2f}"
            )
        for places, is_mirror in self.symmetries():
            if np.array_equal(self.is_donut()[places], self.is_donut()):
                how = "in a mirror" if is_mirror else "turned"
                raise ValueError(f"donut_markers {donuts.numbers} look the same {how}: choose other numbers")

    def _check_cmm(self, cmm_mm: tuple[tuple[float, float], ...]) -> None:
        if len(cmm_mm) != self.count:
            raise ValueError(f"cmm_mm lists {len(cmm_mm)} centres, but the target has {self.count} markers")
        off_mm = np.linalg.norm(np.array(cmm_mm) - self.nominal_mm(), axis=1)
        worst = int(np.argmax(off_mm))
        if off_mm[worst] > _CMM_TOLERANCE * self.spacing_mm:
            raise ValueError(
                f"cmm_mm puts marker {worst + 1} {off_mm[worst]:.3g} mm from its nominal place: wrong order or unit?"
            )

    @property
    def count(self) -> int:
        """How many markers the target has."""
        return self.columns * self.rows

    @property
    def least_markers(self) -> int:
        """How many markers must be found before the target counts as identified."""
        return self.minimum_markers if self.minimum_markers is not None else math.ceil(0.75 * self.count)

    @property
    def is_orientation_assumed(self) -> bool:
        """Whether neither a mark on the target nor its file says which way up it is."""
        is_marked = self.odd_marker is not None or self.donut_markers is not None
        return not is_marked and "nominal_roll_deg" not in self.model_fields_set

    @property
    def orientation(self) -> str:
        """How it is known which way up the target is, in a sentence."""
        if self.odd_marker is not None:
            return f"orientation: by the odd marker {self.odd_marker.number}"
        if self.donut_markers is not None:
            return "orientation: by the donut markers {}, {} and {}".format(*self.donut_markers.numbers)
        stated = (
            "assumed, for the target file does not say" if self.is_orientation_assumed else "as the target file says"
        )
        return (
            f"orientation: {self.name} looks the same after half a turn; its rows are taken to point within 75 deg of "
            f"{self.nominal_roll_deg:g} deg in the image ({stated}: nominal_roll_deg)"
        )

    @property
    def spacing_mm(self) -> float:
        """The distance between nearest neighbours, centre to centre."""
        return self.pitch_mm * (math.sqrt(0.5) if self.layout == "staggered" else 1.0)

    def nominal_mm(self) -> NDArray[np.float64]:
        """Printed centres (N, 2), X and Y in mm, marker 1 at (0, 0)."""
        row, column = np.divmod(np.arange(self.count), self.columns)
        if self.layout == "staggered":
            return np.stack([column + row % 2 / 2, row / 2], axis=1) * self.pitch_mm
        return np.stack([column, row], axis=1) * self.pitch_mm

    def cells(self) -> NDArray[np.intp]:
        """Each marker's place (N, 2) on the square lattice of nearest neighbours, counter-clockwise axes: along rows
        and columns, or, staggered, along the diagonals up right and up left.
        """
        row, column = np.divmod(np.arange(self.count), self.columns)
        if self.layout == "staggered":
            across = 2 * column + row % 2
            return np.stack([(across + row) // 2, (row - across) // 2], axis=1)
        return np.stack([column, row], axis=1)

    def coordinates_mm(self) -> NDArray[np.float64]:
        """Centres (N, 2), X right and Y up in mm: the CMM's where the file has them, else the nominal ones."""
        return np.array(self.cmm_mm, dtype=np.float64) if self.cmm_mm is not None else self.nominal_mm()

    def diameters_mm(self) -> NDArray[np.float64]:
        """Diameter of each marker (N,), mm."""
        diameters = np.full(self.count, self.diameter_mm)
        if self.odd_marker is not None:
            diameters[self.odd_marker.number - 1] = self.odd_marker.diameter_mm
        return diameters

    @property
    def hole_part(self) -> float:
        """The part of a donut marker's area that is its hole; 0 when the target has none."""
        return (self.donut_markers.hole_mm / self.diameter_mm) ** 2 if self.donut_markers is not None else 0.0

    def is_donut(self) -> NDArray[np.bool_]:
        """(N,): markers with a hole."""
        numbers = self.donut_markers.numbers if self.donut_markers is not None else ()
        return np.isin(np.arange(1, self.count + 1), numbers)

    def symmetries(self) -> list[tuple[NDArray[np.intp], bool]]:
        """The turns and mirror images, but for the identity, in which the grid without its marks looks the same: which
        marker (N,), from 0, comes into the place of each, and whether it is a mirror image."""
        centred = self.nominal_mm() - (self.nominal_mm().min(axis=0) + self.nominal_mm().max(axis=0)) / 2
        found: list[tuple[NDArray[np.intp], bool]] = []
        for turns, mirror in [(1, 1), (2, 1), (3, 1), (0, -1), (1, -1), (2, -1), (3, -1)]:
            moved = centred @ np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), turns) * np.array([mirror, 1])
            away = np.linalg.norm(centred[:, None] - moved[None], axis=2)
            if away.min(axis=1).max() < 1e-6 * self.pitch_mm:
                found.append((away.argmin(axis=1), mirror < 0))
        return found

    def row_column(self, number: int) -> tuple[int, int]:
        """Row and column, both from 0, of marker `number` (1..N); row 0 is the bottom one."""
        if not 1 <= number <= self.count:
            raise ValueError(f"markers are numbered 1..{self.count}, not {number}")
        return divmod(number - 1, self.columns)


def load_target(path: Path | str) -> Target:
    """Load the target that a YAML file describes.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    Target
        The target.

    Raises
    ------
    ConfigError
        Which names the file and the key in it, when it cannot be read or something in it is wrong.
    """
    return load_document(Path(path), Target)
