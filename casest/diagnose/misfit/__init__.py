"""Is what is left noise? Imports selection, candidates, noise, levels."""
