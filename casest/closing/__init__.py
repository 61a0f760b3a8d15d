"""Closing the loop: trace a residual to the missing effect, add it, judge by new data."""
