"""Series of frames: what the line with its effects shows on average, its noise, and samples of both.

Files:
    series         mean, variance, correlation and trend of a series, and frames drawn from them
    present_line   effects on beam and noise worked into the twin's numbers, and the effects that are left
    flat_change    what the effects that are left change in a flatfield
    defects        gain pattern and bad pixels that calibration has not seen
    response       counts lost to pile-up, and a curve that bends
    _scene         what stands in the beam, projected once for each beam
    _spread        blur and noise correlation of one series
    _distortion    pictures enlarged and turned
"""
