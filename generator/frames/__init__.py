"""Series of frames: what the line with its effects shows on average, its noise, and samples of both."""
