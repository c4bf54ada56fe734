"""Policies and bounds from the same starts: scores, intervals, oracles and ablations."""
