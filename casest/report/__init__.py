"""What a person reads. Imports results and below; never one another's rooms."""
