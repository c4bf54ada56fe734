"""Recorded scenes in BOP format, and rendered training views."""
