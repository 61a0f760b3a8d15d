"""The loop for estimators in motion: innovations in place of residuals. Imports dynamics."""
