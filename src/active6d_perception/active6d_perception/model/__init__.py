"""Visible surface of an object model per view direction, and distances between its poses."""
