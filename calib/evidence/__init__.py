"""How far a solution can be trusted: uncertainty in pixels, coverage, held-out error, a verdict in words."""
