"""docs/results.md: which commands measure it, its tables and its bars."""
