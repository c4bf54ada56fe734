"""Scenes dropped by physics, the RGB-D camera that looks at them, and recorded scenes."""
