"""Corrected readings: a model inverted, and the inverse as a program. Imports engine and below."""
