"""The stand's own part of an image's drift, to be taken out of marker centres before the rest is called the camera's.

Granite along the axis, refraction and the target's expansion scale the image about the principal point (the middle of
the image); the granite post moves the camera up and the image down. All are relative to a reference state.

The target's centre is taken to be on the optical axis and its plane square to it: at 30 deg of table rotation the scale
of the axial terms is right at the middle of the target and off by up to 8 % of itself at its edge.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.budget.geometry import Geometry, Quantity, StandTemperatures
from thermostand.compensation.budget.refraction import Index, appears_px, ciddor_1996, saturation_Pa

Float = NDArray[np.float64]


def displacement_px(state: StandTemperatures, reference: StandTemperatures, geometry: Geometry, xy_px: Float) -> Float:
    """The displacement of image points (..., 2) by granite, post, target and air, from `reference` to `state`."""
    centre = (np.array(geometry.image_px) - 1) / 2
    offset = np.asarray(xy_px, dtype=np.float64) - centre
    scale = (
        target_strain(state, reference, geometry) - granite_mm(state, reference, geometry) / geometry.distance_mm.value
    )
    post = post_mm(state, reference, geometry) * geometry.focal_px / geometry.distance_mm.value
    roll = math.radians(geometry.camera_roll_deg)
    down = np.array([math.sin(roll), math.cos(roll)])
    refraction = refraction_px(state, geometry, offset) - refraction_px(reference, geometry, offset)
    return scale * offset + post * down + refraction


def varied(state: StandTemperatures, geometry: Geometry) -> Iterator[tuple[StandTemperatures, Geometry]]:
    """State and geometry with one uncertain input after the other larger by its standard uncertainty."""
    for name in Geometry.model_fields:
        quantity = getattr(geometry, name)
        if isinstance(quantity, Quantity) and quantity.u > 0:
            larger = Quantity(value=quantity.value + quantity.u, u=quantity.u)
            yield state, geometry.model_copy(update={name: larger})
    for field in fields(StandTemperatures):
        on_granite = geometry.granite_gradient_K if field.name.startswith("granite") else 0.0
        yield state.warmer_by(**{field.name: math.hypot(geometry.thermometer_K, on_granite)}), geometry


def granite_mm(state: StandTemperatures, reference: StandTemperatures, geometry: Geometry) -> float:
    """How much the base has moved the target away from the camera."""
    inside_K = state.granite_inside_degC - reference.granite_inside_degC
    outside_K = state.granite_outside_degC - reference.granite_outside_degC
    lengths_mm_K = geometry.granite_inside_mm.value * inside_K + geometry.granite_outside_mm.value * outside_K
    return geometry.granite_per_K.value * lengths_mm_K


def post_mm(state: StandTemperatures, reference: StandTemperatures, geometry: Geometry) -> float:
    """How much the post has lifted the camera."""
    inside_K = state.granite_inside_degC - reference.granite_inside_degC
    return geometry.granite_per_K.value * geometry.post_mm.value * inside_K


def target_strain(state: StandTemperatures, reference: StandTemperatures, geometry: Geometry) -> float:
    """Relative growth of the target."""
    return geometry.target_per_K.value * (state.artifact_degC - reference.artifact_degC)


def refraction_px(state: StandTemperatures, geometry: Geometry, offset_px: Float, index: Index = ciddor_1996) -> Float:
    """How far points (..., 2), px from the principal point, appear outwards by the air's indices on both sides."""
    n1, n2 = indices(state, geometry, index)
    return appears_px(offset_px, geometry.focal_px, geometry.distance_mm.value, geometry.interface_mm.value, n1, n2)


def indices(state: StandTemperatures, geometry: Geometry, index: Index = ciddor_1996) -> tuple[float, float]:
    """Refractive indices of the air at the camera and of the laboratory's."""
    pressure_Pa = geometry.pressure_Pa.value
    laboratory_Pa = geometry.relative_humidity.value * saturation_Pa(state.laboratory_degC)
    chamber_Pa = min(laboratory_Pa, saturation_Pa(state.air_degC))
    n1 = 1 + index(state.air_degC, pressure_Pa, chamber_Pa, geometry.wavelength_um)
    return n1, 1 + index(state.laboratory_degC, pressure_Pa, laboratory_Pa, geometry.wavelength_um)
