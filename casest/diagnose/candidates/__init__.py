"""What could be missing, and what each would gain, without a refit. Imports noise, levels."""
