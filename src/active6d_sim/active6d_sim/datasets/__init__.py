"""Recorded scenes in BOP format, and simulated training views."""
