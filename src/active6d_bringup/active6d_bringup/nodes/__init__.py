"""Nodes that record and replay episodes."""
