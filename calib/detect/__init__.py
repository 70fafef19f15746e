"""Finding boards in images."""
