"""Refits judged: which candidate stays. Imports candidates, noise, levels."""
