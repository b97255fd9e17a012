"""raytwin.spectra"""
