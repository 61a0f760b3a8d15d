"""What a saved result is used for: its model again, corrected data, exports. Imports correction."""
