"""The default policy: scores every view of the grid, trained by imitation (DAgger)."""
