"""Noise power to optical spread, gain and read noise.

Files:
    core_width         width of the core, where the tail spreads its light once more
    noise_power        noise power of one series
    series_scatter     whether the noise of series agrees with what is fitted to all
    spread_agreement   measured noise power against the fitted, and a second route to the gain
    spread_average     the average over these, and the one that stands for all
    spread_candidates  one family of spreads at its best
    spread_cells       cells of the frequency plane, electronic noise and slow changes in them
    spread_changes     slow changes between frames: which series have them, how large they are
    spread_families    forms that the optical spread may have, and how likely each is
    spread_fit         optical spread, gain and read noise from the noise power of all series
    spread_members     spreads that the noise leaves open
    spread_normal      normal equations, and the prior of white noise that follows the signal
    spread_problem     the noise power of all series as one problem, linear in all but the spread
"""
