"""Residuals of a sensor as what the loop searches. Imports candidates, formula, protocol."""

from casest.diagnose.sensor.fits import Fit
from casest.diagnose.sensor.sensor import NOT_FINITE, Sensor

__all__ = ["NOT_FINITE", "Fit", "Sensor"]
