"""Records with known truth. Imports correction and below."""
