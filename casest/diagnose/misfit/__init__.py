"""Is what is left noise? Imports candidates, noise, levels."""
