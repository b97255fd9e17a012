"""What a line is: the twin, its beam and limits, and its state from stage to stage, which effects change."""
