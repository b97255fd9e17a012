"""What may differ from the twin, and what each change does to a session, calibration absorbing its part.

Files:
    changes           what may differ: effects with their variants and strengths, nuisances with their prior sizes
    curves            response of the probes to an effect at any strength
    forward_model     the base twin under changes, as series ask it
    responses         change of corrected mean frames and scalars
    calibrated_maps   dark and gain map of the calibrating series, and their noise
    placing           where scenes lie against their thickness maps
    point_maps        maps that were sampled at points
    defects           pixels that stand out
    _node_loops       responses joined at strengths, compiled
"""
