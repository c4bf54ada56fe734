"""Scenes, and the stored scenes with their splits for training, validation and test."""
