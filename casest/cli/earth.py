"""Gravity and magnetic field at a place, from maintained libraries: `pip install casest[earth]`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casest.errors import UsageError, library


@dataclass(frozen=True)
class MagneticField:
    """World Magnetic Model at a place and time: strength in uT, angles in rad (east, down)."""

    strength: float
    declination: float
    inclination: float


def normal_gravity(latitude: float, height: float) -> float:
    """Magnitude of WGS84 normal gravity, m/s², at a geodetic latitude (deg) and height (m).

    Local anomalies, up to about 5e-4 m/s² in mountains, are not in it. Source: the library boule
    (closed form of Li & Götze 2001).
    """
    _check("latitude", latitude, -90, 90)
    _check("height", height, 0, 20_000)
    boule = library("boule", "earth")
    milligal = boule.WGS84.normal_gravity((0.0, latitude, height))
    return float(milligal) * 1e-5


def magnetic_field(latitude: float, longitude: float, height: float, year: float) -> MagneticField:
    """Field of the World Magnetic Model at a place (deg, deg, m) and a decimal year.

    Iron nearby and the crust (some 0.1 uT) are not in it. Source: the library pygeomag with its
    newest coefficients; raises UsageError outside the years that they cover.
    """
    _check("latitude", latitude, -90, 90)
    _check("longitude", longitude, -180, 360)
    pygeomag = library("pygeomag", "earth")
    try:
        found = pygeomag.GeoMag().calculate(
            glat=latitude, glon=longitude, alt=height / 1000, time=year
        )
    except (ValueError, RuntimeError) as error:
        raise UsageError(f"magnetic field for the year {year:g}: {error}") from None
    return MagneticField(
        float(found.total_intensity) * 1e-3, float(np.radians(found.d)), float(np.radians(found.i))
    )


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise UsageError(f"{name} {value:g} is outside {low:g} to {high:g}")
