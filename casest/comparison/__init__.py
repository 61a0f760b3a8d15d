"""Solvers side by side on one problem. Imports estimate and below."""
