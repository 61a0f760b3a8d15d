"""Outside the catalogue: a formula of few terms. Imports candidates, evidence, levels."""
