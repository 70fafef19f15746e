"""Made-up worlds whose truth is known."""
