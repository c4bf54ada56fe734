"""Reports of recorded episodes: numbers, a self-contained HTML page, pictures; and plots of results."""
