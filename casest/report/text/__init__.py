"""What a prompt prints. Imports results."""
