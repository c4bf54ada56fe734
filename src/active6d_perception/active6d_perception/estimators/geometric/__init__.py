"""The training-free estimator: point-pair voting and registration on depth alone."""
