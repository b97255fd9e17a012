"""Series of frames: what the line with its effects shows on average, its noise, and samples of both.

Files, in the way of the light:
    line_model     the line as it is asked: what a series is expected to hold, and frames drawn from it
    scene          what stands in the beam, and where borders cut pixels
    beam           one beam behind one scene, projected once
    declared_spot  blur by the focal spot that the instrument states
    stated_belt    blur by the belt's speed that a series states
    light          what an exposure brings to the pixels: beam, quanta and spread
    memory         what earlier exposures leave behind: lag and burn-in
    stages         from the charge to the stored number: each stage says what is expected, and draws it
    response       counts lost to pile-up, and a curve that bends
    defects        gain pattern and bad pixels that calibration has not seen; noise of lines
    conditions     what a session states of effects' parameters that are not fitted
    present_line   effects on beam and noise worked into the twin's numbers, and the effects that are left
    flat_change    what the effects that are left change in a flatfield
    model_cache    what is made once and kept between calls
    _spread        blur and noise correlation of one series
    _distortion    pictures enlarged and turned
"""
