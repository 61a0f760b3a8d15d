"""Closing the loop for estimators in motion: innovations are diagnosed like residuals."""
