"""Numbers with known noise that frames and forward model both give.

Files:
    probes              names and axes of probes
    map_probes          a mean frame projected on templates
    frame_scalars       noise, times and patterns of measured frames
    model_scalars       the same by the forward model
    line_scalars        what noise of rows and columns adds to scalars
    scalar_context      pixels, times and numbers that both refer to
    fixed_pattern       patterns that stand in mean frames, and pixels that stand out
    lasting             pixels whose level lasts from frame to frame
    tile_seams          where later flats show that tiles of the panel meet
    registration        displacement of a scene against its thickness maps
    straight_edge       how truly a straight edge is drawn, by its oversampled profile
    moving_picture      noise that a fading picture seems to add
    noise_correlation   correlation of neighbouring pixels' noise, summed
    noise_tails         kurtosis of noise of few quanta, and of rounded noise
    _projection_loops   templates weighed by the noise, compiled
"""
