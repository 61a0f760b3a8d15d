"""Closing the loop: what the model lacks, judged on data it never saw.

Imports effects and below.
"""
