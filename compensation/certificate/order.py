"""What a certificate states and no recording knows: who ordered it, who issues it, which item, which certificates.

The keys are those that ISO/IEC 17025:2017, 7.8.2, 7.8.4 and 7.8.6, ask for. Nothing has a value of its own: what an
order lacks is asked for, in one sentence that names all of it.
"""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Annotated

from pydantic import Field, StringConstraints, ValidationError, model_validator

from thermostand.compensation.datasheet.measurement_details import MeasurementDetails
from thermostand.foundation.documents import Document, parse_document, parse_yaml, read_document
from thermostand.foundation.errors import ConfigError

_LINE = r"^[^\x00-\x1f\x7f-\x9f]*$"
Text = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, pattern=_LINE)]
Optional = Annotated[str, StringConstraints(strip_whitespace=True, pattern=_LINE)]
Country = Annotated[str, Field(pattern=r"^[A-Z]{2}$")]
_ABSENT = ("missing", "string_too_short")


class Contact(Document):
    """Of a customer or a laboratory. country: two letters, ISO 3166-1. accreditation: of a laboratory, its mark."""

    name: Text
    street: Optional = ""
    post_code: Optional = ""
    city: Text
    country: Country
    accreditation: Optional = ""

    @property
    def lines(self) -> list[str]:
        """As on a letter."""
        place = f"{self.country}-{self.post_code} {self.city}" if self.post_code else f"{self.city}, {self.country}"
        return [line for line in (self.name, self.street, place, self.accreditation) if line]


class Item(Document):
    """The camera with its lens. serial_number: must be that of the sessions. condition: as it was received."""

    description: Text
    manufacturer: Text
    model: Text
    serial_number: Text
    lens: Text
    lens_serial_number: Text
    condition: Text


class Reference(Document):
    """A reference standard and the certificate that traces it to the SI."""

    identification: Text
    certificate: Text
    issued_by: Text
    issued: date


class Person(Document):
    """Who authorises the certificate."""

    name: Text
    function: Text


class Tolerance(Document):
    """Limits of a quantity, in the unit of the datasheet; one may be left out."""

    lower: float | None = None
    upper: float | None = None

    @model_validator(mode="after")
    def _check_limits(self) -> Tolerance:
        if self.lower is None and self.upper is None:
            raise ValueError("give lower, upper or both")
        if self.lower is not None and self.upper is not None and not self.lower < self.upper:
            raise ValueError(f"lower ({self.lower:g}) is not below upper ({self.upper:g})")
        return self


class Order(Document):
    """A certificate's order. number: of the certificate, unique to it. method: the laboratory's procedure and its
    issue. conditions: of the laboratory, as far as they are not recorded. geometry: the stand's, a file or an installed
    name, by which its own motion is taken out; `none` leaves it in, and the certificate says so. specification: limits,
    by the quantities' keys in the datasheet's JSON file. replaces: number of the certificate that this one replaces."""

    number: Text
    received: date
    issued: date
    customer: Contact
    laboratory: Contact
    item: Item
    method: Text
    conditions: Text
    target: Reference
    thermometers: Reference
    geometry: Text
    authorised_by: Person
    details: MeasurementDetails = Field(default_factory=MeasurementDetails)
    specification: dict[str, Tolerance] = Field(default_factory=dict)
    replaces: Optional = ""
    remarks: Optional = ""


def load_order(path: Path) -> Order:
    """Of a file. ConfigError that asks in one sentence for what is not stated, or names what is wrong."""
    text = read_document(path)
    data = parse_yaml(text, str(path))
    if isinstance(data, dict):
        try:
            return Order.model_validate(data)
        except ValidationError as error:
            faults = [one for one in error.errors() if one["type"] in _ABSENT or one["input"] is None]
            absent = [".".join(map(str, one["loc"])) for one in faults]
            if absent and len(absent) == error.error_count():
                names = " and ".join([", ".join(absent[:-1]), absent[-1]] if len(absent) > 1 else absent)
                raise ConfigError(
                    f"{path}: state {names}; a certificate needs it (ISO/IEC 17025, 7.8), and no recording knows it"
                ) from error
    return parse_document(text, Order, str(path))
