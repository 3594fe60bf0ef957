"""A drift model for other people's programs: a small JSON file and a module that needs numpy and nothing else."""

from __future__ import annotations

import importlib.resources
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev

from thermostand.compensation import drift_runtime
from thermostand.compensation.drift.claims import BetweenSessions
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.paper_model import PaperModel, list_exponents
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.expression import CAMERA, Feature, format_c
from thermostand.compensation.history.thermal_history import Float
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.files import make_folder, write_atomically

MODEL_NAME, MODULE_NAME = "drift.json", "drift_runtime.py"


def export_runtime(model: DriftModel, folder: Path) -> tuple[Path, Path]:
    """Write drift.json and drift_runtime.py into `folder`, made when it is missing; each whole or not at all.

    SessionError when the place refuses.
    """
    make_folder(folder)
    written = folder / MODEL_NAME, folder / MODULE_NAME
    module = importlib.resources.files("thermostand.compensation") / MODULE_NAME
    write_atomically(written[0], json.dumps(build_runtime_model(model), indent=1, allow_nan=False) + "\n")
    write_atomically(written[1], module.read_text(encoding="utf-8"))
    return written


def build_runtime_model(model: DriftModel) -> dict[str, object]:
    """Return what drift_runtime.Drift takes, as JSON values: no covariance; discrepancy_px is one standard deviation of
    the correction inside the calibrated range."""
    facts = model.facts
    common: dict[str, object] = {
        "format": "thermostand drift runtime",
        "version": drift_runtime.VERSION,
        "form": model.form,
        "camera_serial": facts.camera_serial,
        "software_version": facts.software_version,
        "image_size_px": facts.image_size,
        "camera_range_degC": facts.camera_range_degC,
        "reference_degC": facts.reference_degC,
        "discrepancy_px": _compute_residual_px(model).tolist(),
        "hull_px": facts.hull_px.tolist(),
    }
    match model:
        case PaperModel():
            of_form = {"terms_abc": list_exponents(model.degree), "coefficients_px": model.coefficients.tolist()}
        case ThermalModel():
            of_form = _describe_thermal_part(model)
        case _:
            raise TypeError(f"no runtime for a model of form {model.form}")
    return {**common, **of_form}


def _compute_residual_px(model: DriftModel) -> Float:
    """(2,), px: in sessions that were not fitted, as those are in which a running camera asks."""
    match model:
        case ThermalModel(between_sessions=BetweenSessions(sigma_px=between_px)):
            return np.hypot(model.discrepancy_px, between_px)
        case _:
            return model.discrepancy_px


def _describe_thermal_part(model: ThermalModel) -> dict[str, object]:
    valid = model.valid
    return {
        "terms": [model.origin.bind(term.feature) for term in model.terms],
        "ambient_tau_s": model.memory.ambient_lag[2],
        "self_heating_K": model.self_heating_K,
        "reference_ambient_degC": model.reference_ambient_degC,
        "reference_features": model.reference_features.tolist(),
        "coefficients_px": model.coefficients.tolist(),
        "ambient_range_degC": valid.ambient_degC,
        "least_on_s": None if math.isinf(valid.least_on_s) else valid.least_on_s,
        "leverage": valid.leverage,
        "leverage_matrix": model.leverage_matrix.tolist(),
        "history_s": model.history_s,
    }


# A drift model as one C99 header: its numbers as constants, then drift_runtime.h, and in that what the model follows.
#
# A form becomes what C works out quickly: a polynomial of the scaled position whose coefficients are linear in a few
# terms of the thermal state, which are written from their expressions. Products of Chebyshev polynomials are multiplied
# out; at the degrees there are (up to 5) this costs a digit of the sixteen.

_TEMPLATE, _PLACE = "drift_runtime.h", "/* the terms */"


def export_c(model: DriftModel, path: Path) -> Path:
    """Write the header; its names begin with the file's (left.h has left_state, left_advance ...), so that a program
    has several cameras. ConfigError for a file whose name is none in C, SessionError when the place refuses."""
    prefix = path.stem
    if not re.fullmatch("[A-Za-z][A-Za-z0-9_]*", prefix) or path.suffix not in (".h", ".hpp"):
        raise ConfigError(f"{path}: give a name such as drift.h or camera_1.h; what is in it is named after it")
    write_atomically(path, render_header(build_runtime_model(model), prefix))
    return path


def render_header(model: Mapping[str, Any], prefix: str = "drift") -> str:
    """The header of a runtime model, as drift.json holds it."""
    constants = "\n".join(_render_constants(model))
    folder = importlib.resources.files("thermostand.compensation.apply")
    functions = (
        folder.joinpath(_TEMPLATE).read_text(encoding="utf-8").replace(_PLACE, "\n".join(_render_functions(model)))
    )
    guard = "DRIFT_HEADER_H"
    text = (
        f"{_render_banner(model)}#ifndef {guard}\n#define {guard}\n\n{_INCLUDES}\n{constants}\n\n{functions}\n#endif\n"
    )
    return re.sub(r"\bDRIFT_", f"{prefix.upper()}_", re.sub(r"\bdrift_", f"{prefix}_", text))


_INCLUDES = "#include <math.h>\n#include <stddef.h>\n#include <string.h>\n"


def _render_banner(model: Mapping[str, Any]) -> str:
    serial = re.sub(r"[^\w .:-]", "?", str(model["camera_serial"]), flags=re.ASCII)
    left = " and ".join(f"{px:.4f}" for px in model["discrepancy_px"])
    return (
        f"/* Thermal drift of camera {serial}, {model['form']} form, made by thermostand {model['software_version']}.\n"
        f" * Inside the calibrated range the correction is right to {left} px along x and y (one standard deviation).\n"
        " * C99, or C++11. */\n"
    )


def _render_constants(model: Mapping[str, Any]) -> Iterator[str]:
    thermal = model["form"] == "thermal"
    drift = drift_runtime.Drift(model)
    coefficients, degree = _expand_homography(model) if thermal else _expand_polynomial(model)
    width, height = model["image_size_px"]
    yield from _render_defines(
        THERMAL=int(thermal),
        WIDTH=width,
        HEIGHT=height,
        DEGREE=degree,
        FIELD=coefficients.shape[1],
        TERMS=coefficients.shape[2],
        VALUES=len(drift.state.values),
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
        SELF_HEATING_K=float(model.get("self_heating_K", 1.0)),
        MEMORY_S=float(drift.memory_s),
    )
    yield _render_table("drift_coefficients[2][DRIFT_FIELD][DRIFT_TERMS]", coefficients)
    yield _render_table("drift_hull[DRIFT_SIDES][4]", _compute_hull_sides(np.array(model["hull_px"])))
    yield from _render_ranges(model, drift, thermal=thermal)


def _render_functions(model: Mapping[str, Any]) -> Iterator[str]:
    """Return how the state's values go on, and the terms of them."""
    at: dict[Any, int] = drift_runtime.Drift(model).state.memory.at
    values, means = ({part: f"{name}[{place}]" for part, place in at.items()} for name in ("now", "mean"))
    remembered = list(at)[len(drift_runtime.INPUTS) :]
    yield "static inline void drift_rest(double now[DRIFT_VALUES]) {"
    yield from (f"    {values[part]} = {format_c(part[1], values)};" for part in remembered)
    yield "    (void)now;\n}\n"
    yield "static inline void drift_follow(double now[DRIFT_VALUES], double mean[DRIFT_VALUES], double dt_s) {"
    for part in remembered:
        kind, of, size = part
        followed, last = format_c(of, means if kind == "lag" else values), "dt_s, " if kind == "lag" else ""
        yield f"    drift_{kind}(now, mean, {at[part]}, {followed}, {last}{_format_number(size)});"
    yield "    (void)now; (void)mean; (void)dt_s;\n}\n"
    yield "static inline void drift_terms(const double now[DRIFT_VALUES], double terms[DRIFT_TERMS]) {"
    for number, (term, reference) in enumerate(_list_terms(model)):
        yield f"    terms[{number}] = {format_c(term, values)} - {_format_number(reference)};"
    yield "}"


def _list_terms(model: Mapping[str, Any]) -> list[tuple[Feature, float]]:
    """Each term, and what it is at the reference."""
    if model["form"] == "thermal":
        terms: Iterable[Any] = map(drift_runtime.expression_of, model["terms"])
        return list(zip(terms, model["reference_features"], strict=True))
    low, high = model["camera_range_degC"]
    scaled = (CAMERA - (low + high) / 2) / ((high - low) / 2)
    return [(scaled**power if power else 1.0, 0.0) for power in range(1 + int(np.array(model["terms_abc"]).max()))]


def _render_ranges(model: Mapping[str, Any], drift: Any, *, thermal: bool) -> Iterator[str]:
    yield _render_table("drift_camera_range_degC[2]", np.array(drift.limits("camera_range_degC")))
    if not thermal:
        return
    yield _render_table("drift_ambient_range_degC[2]", np.array(drift.limits("ambient_range_degC")))
    yield _render_table("drift_leverage_matrix[DRIFT_TERMS][DRIFT_TERMS]", np.array(model["leverage_matrix"]))
    ambient = drift.state.memory.at[drift.ambient_lag]
    yield from _render_defines(LEAST_ON_S=drift.least_on_s, MOST_LEVERAGE=drift.most_leverage, AMBIENT_LAG=ambient)


def _render_defines(**values: float) -> Iterator[str]:
    for name, value in values.items():
        yield f"#define DRIFT_{name} {value if isinstance(value, int) else _format_number(value)}"


def _expand_homography(model: Mapping[str, Any]) -> tuple[Float, int]:
    """Coefficients (2, 6, H) of 1, x, x^2, y, x y, y^2: the eight motions of drift_runtime."""
    right, down, xx, xy, yx, yy, bend_x, bend_y = np.array(model["coefficients_px"])
    zero = np.zeros_like(right)
    along_i, along_j = [right, xx, bend_x, xy, bend_y, zero], [down, yx, zero, yy, bend_x, bend_y]
    return np.array([along_i, along_j]), 2


def _expand_polynomial(model: Mapping[str, Any]) -> tuple[Float, int]:
    """Coefficients (2, K, n + 1) of x^a y^b t^c, by b and then a."""
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
    return coefficients, degree


def _compute_hull_sides(hull_px: Float) -> Float:
    """(H, 4): direction of each side and where it begins."""
    sides = np.roll(hull_px, -1, axis=0) - hull_px
    return np.hstack([sides / np.linalg.norm(sides, axis=1, keepdims=True), hull_px])


def _render_table(declared: str, values: Float) -> str:
    return f"static const double {declared} = {_render_values(values)};"


def _render_values(values: Float) -> str:
    if values.ndim == 1:
        return _wrap_in_braces(_format_number(float(value)) for value in values)
    return _wrap_in_braces((_render_values(row) for row in values), ",\n    ")


def _wrap_in_braces(parts: Iterable[str], between: str = ", ") -> str:
    return "{ " + between.join(parts) + " }"


def _format_number(value: float) -> str:
    """Write a number as C reads it, to the last bit."""
    return ("-" if value < 0 else "") + "HUGE_VAL" if np.isinf(value) else repr(float(value))


# A drift model as a ROS 2 package: the node, the runtime module and the model, to be built by colcon where ROS is.

PACKAGE = "camera_drift"


def export_ros2(model: DriftModel, folder: Path) -> tuple[Path, ...]:
    """Write the package `camera_drift` into `folder`, made when it is missing; each file whole or not at all.

    SessionError when the place refuses.
    """
    module = folder / PACKAGE
    written = list(export_runtime(model, _ensure_folder(folder) / PACKAGE))
    files = {
        folder / "package.xml": _read_template("package.xml"),
        folder / "setup.py": _read_template("setup.py.txt"),
        folder / "setup.cfg": _read_template("setup.cfg"),
        _ensure_folder(folder / "resource") / PACKAGE: "",
        module / "__init__.py": "",
        module / "drift_node.py": _read_template("drift_node.py"),
    }
    for path, text in files.items():
        write_atomically(path, text.replace("@VERSION@", _format_version(model)))
        written.append(path)
    return tuple(written)


def _ensure_folder(folder: Path) -> Path:
    make_folder(folder)
    return folder


def _read_template(name: str) -> str:
    return (
        importlib.resources.files("thermostand.compensation.apply").joinpath("ros2", name).read_text(encoding="utf-8")
    )


def _format_version(model: DriftModel) -> str:
    """Return the version as three numbers, as package.xml wants them."""
    parts = [part for part in model.facts.software_version.split(".") if part.isdecimal()]
    return ".".join([*parts, "0", "0", "0"][:3])
