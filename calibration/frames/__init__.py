"""Frames before they are noise or level: sums, darks, bad pixels, what a camera does to them.

Files:
    frame_sums           sums over the frames of a series, in one pass
    _kept_sums           sums of many series, on disk where they are large
    _kernels             compiled loops
    dark_frames          dark level, growth with exposure, read noise
    bad_pixels           pixels that are bad, and why
    interpolated_pixels  pixels that hold means of their neighbours
    full_scale           series that reach the end of the ADC's range
    frame_checks         copies of frames, change of scene
    code_steps           distance of the ADC's codes
    robust               standard deviation by most values
    frame_memory         noise that frames take over from those before them
"""
