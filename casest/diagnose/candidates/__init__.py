"""What could be missing, and the slopes of the residual in it. Imports evidence."""
