"""Scenes, and the stored ones with their train, validation and test splits."""
