"""Levels, gains, wedges and dosimeters to a posterior of tube and detector.

Files:
    priors              what is known before flats are looked at
    dose_data           dosimeter readings as data of the spectral fit
    output_table        dose tables
    transmission_table  transmission tables
    _measured_table     CSV tables
    spectral_data       what flats, wedges and dosimeters say of it
    spectral_model      the declared tube and detector, and priors
    spectral_posterior  the posterior given these
    posterior_draws     draws from it
    spectral_fit        posterior of tube, filtration and scintillator
    wedges              plates of known thickness
    tube                a tube calibrated with a dosimeter
"""
