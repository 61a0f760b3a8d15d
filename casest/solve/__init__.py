"""Floor 6: solvers, certificate, covariance."""
