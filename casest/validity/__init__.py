"""Is an old calibration still valid for a new record? Its test, what changed, the control chart."""
