"""The simulated RGB-D camera: renderer, appearance and sensor noise."""
