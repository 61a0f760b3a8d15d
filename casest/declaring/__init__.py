"""Floor 1: symbols, shapes and the vocabulary of physics."""
