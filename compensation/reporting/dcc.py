"""A certificate as a digital calibration certificate: XML of the schema DCC 3.3.0 of PTB, with D-SI 2.2 quantities.

Element names, their order and what they hold: https://www.ptb.de/dcc/v3.3.0/ and https://www.ptb.de/si/v2.2.0/. Only
what is stated or measured is written. A pixel is no unit of the SI: it is counted, so its unit is \\one.
"""

from __future__ import annotations

import importlib.metadata
import math
import re
from collections.abc import Sequence
from xml.etree import ElementTree as ET

from thermostand.compensation.certificate.certificate import PROBABILITY, Certificate, CertifiedValue, Conformity
from thermostand.compensation.certificate.order import Contact, Reference
from thermostand.compensation.reporting.equipment import Line
from thermostand.compensation.reporting.pages import NOTES, list_certificate_facts

VERSION = "3.3.0"
_DCC, _SI = "https://ptb.de/dcc", "https://ptb.de/si"
_XSI = "http://www.w3.org/2001/XMLSchema-instance"
_UNITS = {
    "px": (1.0, r"\one"),
    "mpx": (1e-3, r"\one"),
    "px/K": (1.0, r"\one\kelvin\tothe{-1}"),
    "mpx/min": (1e-3, r"\one\minute\tothe{-1}"),
    "ppm": (1.0, r"\ppm"),
    "ppm/K": (1.0, r"\ppm\kelvin\tothe{-1}"),
    "µrad": (1.0, r"\micro\radian"),
    "µrad/K": (1.0, r"\micro\radian\kelvin\tothe{-1}"),
    "s": (1.0, r"\second"),
    "K": (1.0, r"\kelvin"),
    "%": (1.0, r"\percent"),
    "°C": (1.0, r"\degreecelsius"),
}
"""Unit of a datasheet -> factor and unit of D-SI."""
_STATUS = {
    ("conforms", True): "pass",
    ("does not conform", False): "fail",
    ("neither is proven", True): "conditionalPass",
    ("neither is proven", False): "conditionalFail",
}
Element = ET.Element


def serialise_dcc(made: Certificate, equipment: Sequence[Line] = ()) -> str:
    """The same values as the page, as XML text."""
    for prefix, namespace in (("dcc", _DCC), ("si", _SI), ("xsi", _XSI)):
        ET.register_namespace(prefix, namespace)
    root = _make("digitalCalibrationCertificate", schemaVersion=VERSION)
    root.set(f"{{{_XSI}}}schemaLocation", f"{_DCC} https://ptb.de/dcc/v{VERSION}/dcc.xsd")
    root.extend([_make_administrative_data(made), _make_results(made, equipment)])
    ET.indent(root, " ")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _make(name: str, *content: Element | str, namespace: str = _DCC, **attributes: str) -> Element:
    element = Element(f"{{{namespace}}}{name}", attributes)
    for each in content:
        if isinstance(each, str):
            element.text = "".join(
                sign if sign.isprintable() else " " for sign in each
            )  # XML has no control characters
        else:
            element.append(each)
    return element


def _make_text(name: str, text: str, **attributes: str) -> Element:
    """Of a text or rich text, in English."""
    return _make(name, _make("content", text, lang="en"), **attributes)


def _make_contact(name: str, of: Contact) -> Element:
    places = {"street": of.street, "postCode": of.post_code, "city": of.city, "countryCode": of.country}
    location = _make("location", *(_make(key, " ".join(text.split())) for key, text in places.items() if text))
    return _make(name, _make_text("name", of.name), location)


def _make_identification(issuer: str, value: str, name: str) -> Element:
    return _make(
        "identification", _make("issuer", issuer), _make("value", " ".join(value.split())), _make_text("name", name)
    )


def _make_software() -> Element:
    version = importlib.metadata.version("thermostand")
    return _make("software", _make_text("name", "thermostand"), _make("release", version))


def _make_administrative_data(made: Certificate) -> Element:
    order, item = made.order, made.order.item
    first, last = made.performed
    core = [
        _make("countryCodeISO3166_1", order.laboratory.country),
        _make("usedLangCodeISO639_1", "en"),
        _make("mandatoryLangCodeISO639_1", "en"),
        _make("uniqueIdentifier", " ".join(order.number.split())),
        _make("receiptDate", order.received.isoformat()),
        _make("beginPerformanceDate", first.isoformat()),
        _make("endPerformanceDate", last.isoformat()),
        _make("performanceLocation", "laboratory"),
        _make("issueDate", order.issued.isoformat()),
    ]
    if order.replaces:
        replaced = _make("replacedUniqueIdentifier", " ".join(order.replaces.split()))
        core.append(_make("reportAmendedSubstituted", _make("typeOfChange", "substituted"), replaced))
    camera = _make(
        "item",
        _make_text("name", item.description),
        _make_text("description", f"Condition as received: {item.condition}"),
        _make("manufacturer", _make_text("name", item.manufacturer)),
        _make("model", " ".join(item.model.split())),
        _make(
            "identifications",
            _make_identification("manufacturer", item.serial_number, "Serial number of the camera"),
            _make_identification("manufacturer", item.lens_serial_number, f"Serial number of the lens {item.lens}"),
        ),
    )
    signer = _make(
        "respPerson",
        _make("person", _make_text("name", order.authorised_by.name)),
        _make("role", " ".join(order.authorised_by.function.split())),
        _make("mainSigner", "true"),
    )
    return _make(
        "administrativeData",
        _make("dccSoftware", _make_software()),
        _make("coreData", *core),
        _make("items", camera),
        _make("calibrationLaboratory", _make_contact("contact", order.laboratory)),
        _make("respPersons", signer),
        _make_contact("customer", order.customer),
        _make("statements", *_make_statements(made)),
    )


def _make_statements(made: Certificate) -> list[Element]:
    notes: list[str] = [*NOTES]
    if made.sheet.observations.simulated:
        notes.insert(
            0, "Specimen: recorded in a simulated laboratory. Nothing was measured, and this certifies nothing."
        )
    notes.append(
        "The motion of the stand itself is taken out."
        if made.is_corrected
        else "The motion of the stand is in the values."
    )
    if made.order.laboratory.accreditation:
        notes.append(f"Accreditation: {made.order.laboratory.accreditation}")
    if made.order.remarks:
        notes.append(made.order.remarks)
    plain = [_make("statement", _make_text("declaration", text)) for text in notes]
    return [*plain, *map(_make_conformity, made.conformities)]


def _make_conformity(one: Conformity) -> Element:
    unit = one.value.quantity.unit
    limits = {"Lower limit": one.lower, "Upper limit": one.upper, "Guard band": one.guard}
    return _make(
        "statement",
        _make_text("name", f"Conformity of {one.value.quantity.name}"),
        _make("norm", "ISO 14253-1:2017"),
        _make_text("declaration", f"{one.verdict}; decision rule of ISO 14253-1 at a probability of 95 %"),
        _make("conformity", _STATUS[one.verdict, one.within]),
        _make("data", *(_make_quantity(name, x, unit) for name, x in limits.items() if x is not None)),
        refId=_make_id(one.value.quantity.key),
    )


def _make_results(made: Certificate, equipment: Sequence[Line]) -> Element:
    order, sheet = made.order, made.sheet
    ranges = {"Air near the camera": sheet.air_degC, "Camera's own sensor": sheet.camera_degC}
    if made.laboratory_degC is not None:
        ranges["Air of the laboratory"] = made.laboratory_degC
    conditions = [
        _make(
            "influenceCondition",
            _make_text("name", name),
            _make("data", _make_quantity("lowest", low, "°C"), _make_quantity("highest", high, "°C")),
        )
        for name, (low, high) in ranges.items()
    ]
    conditions.append(
        _make(
            "influenceCondition",
            _make_text("name", "Laboratory, as stated"),
            _make("data", _make_text("text", order.conditions)),
        )
    )
    models = "; ".join(dict.fromkeys(f"{one.quantity.name}: {one.quantity.model}" for one in made.values))
    result = _make(
        "result",
        _make_text("name", "Drift of the image over temperature"),
        _make("data", *(_make_value(one) for one in made.values)),
    )
    records = dict(list_certificate_facts(made))["Records"]
    measured = _make(
        "measurementResult",
        _make_text("name", "Thermal drift of a camera"),
        _make(
            "usedMethods",
            _make(
                "usedMethod",
                _make_text("name", order.method),
                _make_text("description", f"{models}. {records}"),
                _make("norm", "JCGM 100:2008"),
                _make("norm", "JCGM 101:2008"),
            ),
        ),
        _make("usedSoftware", _make_software()),
        _make(
            "measuringEquipments",
            _make_reference("Target", order.target),
            _make_reference("Thermometers", order.thermometers),
            *(
                _make("measuringEquipment", _make_text("name", name), _make_text("description", text))
                for name, text in equipment
            ),
        ),
        _make("influenceConditions", *conditions),
        _make("results", result),
    )
    return _make("measurementResults", measured)


def _make_reference(name: str, one: Reference) -> Element:
    text = f"Traceable by certificate {one.certificate} of {one.issued_by}, {one.issued.isoformat()}"
    return _make(
        "measuringEquipment",
        _make_text("name", f"{name} {one.identification}"),
        _make_text("description", text),
        _make("identifications", _make_identification("calibrationLaboratory", one.certificate, "Certificate")),
    )


def _make_value(one: CertifiedValue) -> Element:
    quantity = one.quantity
    factor = _UNITS[quantity.unit][0]
    uncertainty = _make_si(
        "expandedMU",
        _make_si("valueExpandedMU", _format(factor * one.expanded)),
        _make_si("coverageFactor", _format(one.k)),
        _make_si("coverageProbability", _format(PROBABILITY)),
    )
    element = _make_quantity(quantity.name, quantity.value, quantity.unit, uncertainty)
    element.set("id", _make_id(quantity.key))
    return element


def _make_quantity(name: str, value: float, unit: str, uncertainty: Element | None = None) -> Element:
    factor, dsi = _UNITS[unit]
    real = _make_si("real", _make_si("value", _format(factor * value)), _make_si("unit", dsi))
    if uncertainty is not None:
        real.append(_make_si("measurementUncertaintyUnivariate", uncertainty))
    return _make("quantity", _make_text("name", name), real)


def _make_si(name: str, *content: Element | str) -> Element:
    return _make(name, *content, namespace=_SI)


def _make_id(key: str) -> str:
    return "q_" + re.sub(r"\W", "_", key)


def _format(value: float) -> str:
    if not math.isfinite(value):
        raise ValueError(f"{value} is no number of a certificate")
    return f"{value:.9g}"
