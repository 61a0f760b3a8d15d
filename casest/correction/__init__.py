"""Corrected readings: inverted, applied, exported.

Imports results and below; `inverse` comes before results, which tell how it is applied.
"""
