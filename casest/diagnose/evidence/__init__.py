"""What columns beside a fit are worth: likelihood with its own noise, held-out error. Imports levels."""
