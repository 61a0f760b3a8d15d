"""Causes that a record did not tell apart, and the measurements that do.

T-optimal (Atkinson & Fedorov 1975): were one of them true, the other would not fit, however its
parameters are chosen.
"""
