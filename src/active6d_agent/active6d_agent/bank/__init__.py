"""Scene banks: stored estimator results of every view of every scene, and their fusion for many episodes at once."""
