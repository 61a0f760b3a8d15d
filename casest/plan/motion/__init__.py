"""The motion that makes all states observable best, within limits: inputs over time to fly."""
