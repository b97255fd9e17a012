"""Series of flats to levels, noise and evidence.

Files:
    repeated_frames  noise where flats are single frames
    noise_sources    the series that the fit of the noise takes
    noise_of_flats   this fit, less flats that bend away from the line
    flat_levels      each series as photon transfer sees it, the level of each beam, the gain map
    common_noise     noise that the pixels of a frame share
    flat_evidence    drift, lag, linearity, repeats, shape of the noise
    setting_errors   exposures, distances and a response that are not as stated
    photon_transfer  darks and flats to maps, noise and levels, top to bottom
"""
