"""The correction of a saved result, ready to run on the device: C99, Python with NumPy, JSON."""
