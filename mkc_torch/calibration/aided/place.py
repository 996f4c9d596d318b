"""The earth's field at a place and date, by the World Magnetic Model."""

from __future__ import annotations

import datetime
import math
import re
from typing import NamedTuple

_FIRST = datetime.date(2015, 1, 1)
"""First date of the models in ahrs: those of 2015, 2020 and 2025, valid for five years each."""

_BEYOND = datetime.date(2030, 1, 1)
"""First date after the models in ahrs."""


class Field(NamedTuple):
    """Length in µT, inclination below the horizon and declination to the east in rad."""

    strength: float
    inclination: float
    declination: float


def earth_field(latitude: float, longitude: float, altitude: float, date: datetime.date) -> Field:
    """The field of the World Magnetic Model at a place and date, by the package ahrs (MIT).

    The model has a standard deviation of about 0.15 µT and 0.2°; rock and buildings add at least as much.

    Args:
        latitude: north, in °.
        longitude: east, in °, from -180 to 360.
        altitude: above the ellipsoid, in m.
        date: date from 2015 to 2029.

    Raises:
        ValueError: a place or date out of range.
        ImportError: ahrs is not installed.

    References:
        NOAA & BGS, "The US/UK World Magnetic Model for 2025-2030" (2024).

    Example:
        >>> field = earth_field(48.1, 11.6, 520.0, datetime.date(2026, 5, 1))  # doctest: +SKIP
        >>> round(field.strength, 1), round(math.degrees(field.inclination), 1)  # doctest: +SKIP
        (48.7, 64.3)
    """
    for name, value, least, most in (("latitude", latitude, -90, 90), ("longitude", longitude, -180, 360)):
        if not least <= value <= most:
            raise ValueError(f"Expected the {name} from {least}° to {most}° but got {value:g}.")
    if not -1e4 <= altitude <= 8.5e5:
        raise ValueError(f"Expected the altitude from -10 km to 850 km, in m, but got {altitude:g} m.")
    if not _FIRST <= date < _BEYOND:
        raise ValueError(
            f"Expected a date from {_FIRST} to {_BEYOND - datetime.timedelta(days=1)}, which the World Magnetic Models "
            f"of ahrs cover, but got {date}."
        )
    try:
        from ahrs.utils import WMM
    except ImportError as error:
        raise ImportError("The World Magnetic Model needs ahrs: pip install 'mkc-torch[wmm]'.") from error
    model = WMM(date)
    # the constructor treats latitude 0 and longitude 0 as missing
    model.magnetic_field(latitude, longitude if longitude <= 180.0 else longitude - 360.0, 1e-3 * altitude, date=date)
    return Field(1e-3 * float(model.F), math.radians(float(model.I)), math.radians(float(model.D)))


def parsed_place(text: str) -> tuple[float, float, float]:
    """Parse "LAT,LON" or "LAT,LON,ALT" to latitude and longitude in °, and altitude in m.

    Raises:
        ValueError: another format.

    Example:
        >>> parsed_place("48.1,11.6")
        (48.1, 11.6, 0.0)
    """
    parts = re.split(r"[,; ]+", text.strip())
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
        raise ValueError(f"Expected LAT,LON or LAT,LON,ALT in ° and m, such as 48.1,11.6,520, but got {text!r}.")
    return numbers[0], numbers[1], numbers[2] if len(numbers) == 3 else 0.0


def parsed_date(text: str) -> datetime.date:
    """Parse a date YYYY-MM-DD.

    Raises:
        ValueError: another format.
    """
    try:
        return datetime.date.fromisoformat(text.strip())
    except ValueError:
        raise ValueError(f"Expected a date as YYYY-MM-DD, such as 2026-05-01, but got {text!r}.") from None
