"""Twins as files, tables, pictures, answers, and in the form of other simulators.

Files:
    twin_io       the twin file
    twin_answer   a twin as plain numbers and as a table
    twin_plot     pictures of a twin
    shipped       calibrations that come with raytwin
    export        spectra, response, spread and noise for other simulators
"""
