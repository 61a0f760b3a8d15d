"""One least-squares problem from a model and its runs.

Imports data, engine, declaration and below.
"""
