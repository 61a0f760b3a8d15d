"""Floor 2: models and effects as values."""
