"""One figure for each claim of a subject, measured in one call; see `python -m bench.figures`."""
