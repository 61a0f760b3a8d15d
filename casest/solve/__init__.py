"""Solvers of one least-squares problem. Imports leastsquares and below."""
