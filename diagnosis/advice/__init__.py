"""What to measure next, and what a session could tell."""
