"""The report of a recorded episode: numbers, one self-contained HTML page, one picture."""
