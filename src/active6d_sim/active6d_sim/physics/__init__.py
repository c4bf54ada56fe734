"""Piles of objects, simulated by rigid-body physics."""
