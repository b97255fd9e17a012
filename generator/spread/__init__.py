"""Where light and noise spread to: optical spread, sharp borders of objects, noise of a frame, shifts between pictures."""
