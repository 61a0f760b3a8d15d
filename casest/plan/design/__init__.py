"""Optimal design: which of many candidates, how often, and how far from the best possible.

A candidate is the whitened Jacobian (k, n) of what it would measure; the information of a design is
what there is already plus the sum of JᵀJ. Knows no models.
"""
