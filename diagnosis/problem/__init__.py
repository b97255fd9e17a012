"""A session and its twin as one problem: residual, nuisances, responses to every effect.

Files:
    assemble           session and twin to problem, top to bottom
    problem            the problem: residual, factors, curves, names
    asked_again        further variants; nuisances where effects have been found
    series_probes      one series projected: templates, scalars, residual
    series_block       one series in numbers: residual, nuisances, responses, random parts
    nuisance_columns   nuisances of one series
    other_scenes       scenes as they may be instead
    scenes_apart       scenes that each lie elsewhere by an amount of its own
    surroundings       light that effects bring in from beyond the borders
    line_noise         noise of rows and columns that is no effect
    output_course      levels and trends of a drifting output
"""
