"""What every command leaves behind, as values that text, page and JSON read.

Imports diagnose and below.
"""
