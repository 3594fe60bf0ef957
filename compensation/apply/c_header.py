"""A drift model as one C99 header: its numbers as constants, then drift_runtime.h, which is the same for every model.

A form becomes what C works out quickly: a polynomial of the scaled position whose coefficients are linear in a few
terms of the thermal state. Products of Chebyshev polynomials are multiplied out; at the degrees there are (up to 5)
this costs a digit of the sixteen.
"""

from __future__ import annotations

import importlib.resources
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from thermostand.compensation import drift_runtime
from thermostand.compensation.apply.runtime_export import runtime_model
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.terms import Kind, power_of
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.files import write_whole

Float = NDArray[np.float64]

_TEMPLATE = "drift_runtime.h"
_KINDS = ("constant", "camera", "ambient lag", "camera lag", "play")


@dataclass(frozen=True, slots=True)
class _CTerm:
    """((the state's value `at` this index - origin) / span) ** power - reference."""

    kind: str
    at: int
    power: int
    origin: float
    span: float
    reference: float


def export_c(model: DriftModel, path: Path) -> Path:
    """Write the header; its names begin with the file's (left.h has left_state, left_advance ...), so that a program
    has several cameras. ConfigError for a file whose name is none in C, SessionError when the place refuses."""
    prefix = path.stem
    if not re.fullmatch("[A-Za-z][A-Za-z0-9_]*", prefix) or path.suffix not in (".h", ".hpp"):
        raise ConfigError(f"{path}: give a name such as drift.h or camera_1.h; what is in it is named after it")
    write_whole(path, header_text(runtime_model(model), prefix))
    return path


def header_text(model: Mapping[str, Any], prefix: str = "drift") -> str:
    """The header of a runtime model, as drift.json holds it."""
    constants = "\n".join(_constants(model))
    functions = (
        importlib.resources.files("thermostand.compensation.apply").joinpath(_TEMPLATE).read_text(encoding="utf-8")
    )
    guard = "DRIFT_HEADER_H"
    text = f"{_about(model)}#ifndef {guard}\n#define {guard}\n\n{_INCLUDES}\n{constants}\n\n{functions}\n#endif\n"
    return re.sub(r"\bDRIFT_", f"{prefix.upper()}_", re.sub(r"\bdrift_", f"{prefix}_", text))


_INCLUDES = "#include <math.h>\n#include <stddef.h>\n#include <string.h>\n"


def _about(model: Mapping[str, Any]) -> str:
    serial = re.sub(r"[^\w .:-]", "?", str(model["camera_serial"]), flags=re.ASCII)
    left = " and ".join(f"{px:.4f}" for px in model["discrepancy_px"])
    return (
        f"/* Thermal drift of camera {serial}, {model['form']} form, made by thermostand {model['software_version']}.\n"
        f" * Inside the calibrated range the correction is right to {left} px along x and y (one standard deviation).\n"
        " * C99, or C++11. */\n"
    )


def _constants(model: Mapping[str, Any]) -> Iterator[str]:
    thermal = model["form"] == "thermal"
    terms, coefficients, degree = _thermal(model) if thermal else _paper(model)
    width, height = model["image_size_px"]
    taus_s, plays_K, parts = model.get("taus_s", ()), model.get("plays_K", ()), _parts(model)
    yield from _definitions(
        THERMAL=int(thermal),
        WIDTH=width,
        HEIGHT=height,
        DEGREE=degree,
        FIELD=coefficients.shape[1],
        TERMS=len(terms),
        LAGS=1 + len(taus_s),
        PLAYS=len(plays_K) + len(parts),
        PARTS=len(parts),
        SIDES=len(model["hull_px"]),
        STEP_PX=drift_runtime.LATTICE_PX,
        CELLS_X=-(-width // drift_runtime.LATTICE_PX),
        ROUNDS=drift_runtime.ROUNDS,
        MIDDLE_X=(width - 1) / 2,
        MIDDLE_Y=(height - 1) / 2,
        SPAN_X=width / 2,
        SPAN_Y=width / 2 if thermal else height / 2,
        HULL_MARGIN_PX=drift_runtime.HULL_MARGIN_PX,
        COLD_K=drift_runtime.COLD_K,
        UNPOWERED_TAU_S=drift_runtime.UNPOWERED_TAU_S,
        MEMORY_S=float(drift_runtime.Drift(model).memory_s),
    )
    yield f"enum {{ {', '.join(_kind_name(kind) for kind in _KINDS)} }};"
    yield "static const struct { int kind, at, power; double origin, span, reference; } drift_terms[DRIFT_TERMS] = {"
    for term in terms:
        numbers = ", ".join(_number(value) for value in (term.origin, term.span, term.reference))
        yield f"    {{ {_kind_name(term.kind)}, {term.at}, {term.power}, {numbers} }},"
    yield "};"
    yield _table("drift_coefficients[2][DRIFT_FIELD][DRIFT_TERMS]", coefficients)
    yield _table("drift_taus_s[DRIFT_LAGS]", np.array([drift_runtime.RATE_TAU_S, *taus_s]))
    yield _table("drift_plays_K[DRIFT_PLAYS + 1]", np.array([*plays_K, *(radius_K for _, _, radius_K in parts), 0.0]))
    yield "static const struct { int lag; double share; } drift_parts[DRIFT_PARTS + 1] = {"
    for tau_s, share, _ in parts:
        yield f"    {{ {1 + list(taus_s).index(tau_s)}, {_number(share)} }},"
    yield "    { 0, 0.0 }\n};"
    yield _table("drift_hull[DRIFT_SIDES][4]", _sides(np.array(model["hull_px"])))
    yield from _ranges(model, thermal=thermal)


def _ranges(model: Mapping[str, Any], *, thermal: bool) -> Iterator[str]:
    drift = drift_runtime.Drift(model)
    yield _table("drift_camera_range_degC[2]", np.array(drift.limits("camera_range_degC")))
    if not thermal:
        return
    yield _table("drift_ambient_range_degC[2]", np.array(drift.limits("ambient_range_degC")))
    yield _table("drift_leverage_matrix[DRIFT_TERMS][DRIFT_TERMS]", np.array(model["leverage_matrix"]))
    yield from _definitions(LEAST_ON_S=drift.least_on_s, MOST_LEVERAGE=drift.most_leverage)


def _definitions(**values: float) -> Iterator[str]:
    for name, value in values.items():
        yield f"#define DRIFT_{name} {value if isinstance(value, int) else _number(value)}"


def _thermal(model: Mapping[str, Any]) -> tuple[list[_CTerm], Float, int]:
    """Coefficients (2, 6, H) of 1, x, x^2, y, x y, y^2: the eight motions of drift_runtime."""
    taus_s, plays_K, parts = list(model["taus_s"]), list(model["plays_K"]), _parts(model)
    camera, air = model["reference_degC"], model["reference_ambient_degC"]
    span = drift_runtime.SPAN_K
    terms: list[_CTerm] = []
    for (kind, parameter, *of_part), reference in zip(model["terms"], model["reference_features"], strict=True):
        base = kind.removesuffix(" squared").removesuffix(" cubed")
        at = 1 + taus_s.index(parameter) if parameter in taus_s else 0
        at = plays_K.index(parameter) if base == "play" else at
        if of_part:
            tau_s, share = of_part
            at = len(plays_K) + parts.index((tau_s, share, parameter))
            terms.append(_CTerm("play", at, 1, air + share * (camera - air), span, reference))
            continue
        origin = {"constant": 0.0, "ambient lag": air}.get(base, camera)
        power = 0 if base == "constant" else power_of(Kind(kind))
        terms.append(_CTerm(base, at, power, origin, span, reference))
    right, down, xx, xy, yx, yy, bend_x, bend_y = np.array(model["coefficients_px"])
    zero = np.zeros_like(right)
    along_i, along_j = [right, xx, bend_x, xy, bend_y, zero], [down, yx, zero, yy, bend_x, bend_y]
    return terms, np.array([along_i, along_j]), 2


def _parts(model: Mapping[str, Any]) -> list[tuple[float, float, float]]:
    return [(float(tau_s), float(share), float(radius_K)) for tau_s, share, radius_K in model.get("part_plays", ())]


def _paper(model: Mapping[str, Any]) -> tuple[list[_CTerm], Float, int]:
    """Coefficients (2, K, n + 1) of x^a y^b t^c, by b and then a."""
    low, high = model["camera_range_degC"]
    exponents = np.array(model["terms_abc"])
    degree = int(exponents.max())
    count = degree + 1
    unit = np.eye(count)
    powers = np.array([np.pad(chebyshev.cheb2poly(unit[k, : k + 1]), (0, degree - k)) for k in range(count)])
    full = np.zeros((2, count, count, count))
    for axis, row in enumerate(model["coefficients_px"]):
        full[axis][tuple(exponents.T)] = row
    full = np.einsum("sabc,ai,bj,ck->sijk", full, powers, powers, powers)
    places = [(a, b) for b in range(count) for a in range(count - b)]
    coefficients = np.stack([full[:, a, b] for a, b in places], axis=1)
    middle, half = (low + high) / 2, (high - low) / 2
    return [_CTerm("camera", 0, power, middle, half, 0.0) for power in range(count)], coefficients, degree


def _sides(hull_px: Float) -> Float:
    """(H, 4): direction of each side and where it begins."""
    sides = np.roll(hull_px, -1, axis=0) - hull_px
    return np.hstack([sides / np.linalg.norm(sides, axis=1, keepdims=True), hull_px])


def _table(declared: str, values: Float) -> str:
    return f"static const double {declared} = {_braced(values)};"


def _braced(values: Float) -> str:
    if values.ndim == 1:
        return _joined(_number(float(value)) for value in values)
    return _joined((_braced(row) for row in values), ",\n    ")


def _joined(parts: Iterable[str], between: str = ", ") -> str:
    return "{ " + between.join(parts) + " }"


def _number(value: float) -> str:
    """As C reads it, to the last bit."""
    return ("-" if value < 0 else "") + "HUGE_VAL" if np.isinf(value) else repr(float(value))


def _kind_name(kind: str) -> str:
    return "DRIFT_OF_" + kind.upper().replace(" ", "_")
