"""What a line is: the twin, its beam and limits, and its state from stage to stage, which effects change.

Files:
    twin              the twin: maps, noise, levels per beam, posterior of the spectrum, effects
    spectral_signal   level, gain, photons and kerma of an open beam, for many parameter sets at once
    photon_tables     what tubes send and scintillators keep at each photon energy, at nodes of voltage and thickness
    measured_flats    the flats that a twin was calibrated with
    twin_spectrum     a twin's spectral model; photon-transfer slope over gain; secondary quanta
    twin_numbers      a twin with another gain or spectrum, its levels moved along
    line_state        the stages from beam to ADC, and what the state of the line holds at each
    applied_effect    an effect as one line has it: id, parameters, since when
    series_request    what one series states of itself
    belt_path         how far a belt moves in one exposure
    line_limits       tube load, readout, belt and count rate that a line can have
    binning           signal and noise of b x b pixels
    rounding          variance that coarse steps of the ADC add
"""
