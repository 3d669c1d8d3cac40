"""Long checks with a verdict: fault grid, kills, soak, causes, statistics."""
