"""Training of the learned estimator: stored training views, losses, the loop, validation and curves."""
