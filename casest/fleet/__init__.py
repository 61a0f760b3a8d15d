"""Many sensors of one model at once, each on its own. Imports estimate and below."""
