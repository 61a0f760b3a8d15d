"""Corrected readings: inverted, applied, exported. Imports results and below."""
