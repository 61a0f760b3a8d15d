"""Fit, prove, say how sure, and remark. Imports solve, leastsquares and below."""
