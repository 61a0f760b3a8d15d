"""What every command leaves behind, as values that text, page and JSON read.

Frozen, and built once: what is decided is decided here or below, never when it is printed. Imports
comparison, correction and below.
"""
