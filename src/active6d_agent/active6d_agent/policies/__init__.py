"""View policies: the interface, the registry, the paper's baselines and the learned policies."""
