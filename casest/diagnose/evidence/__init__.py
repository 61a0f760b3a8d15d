"""What columns beside a fit are worth: likelihood, price, held-out error. Imports levels."""
