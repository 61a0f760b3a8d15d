"""What a model is: symbols, shapes, physics, models and effects as values.

Imports units, errors.
"""
