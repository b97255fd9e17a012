"""The measured session: its series, what their frames say in one pass, which of them can be compared.

Files:
    preparation   series that are left out, labels that frames contradict, the twin, where its spectrum is taken as linear
    session       which series calibrate, and what each asks of the forward model
    usable        which series can be compared, and the two passes over their frames
    summaries     statistics of the frames of one series
    origin        whether a twin was calibrated from these very series
    binning       how many pixels are binned on large panels
    binned_twin   a twin with squares of pixels for pixels
    even_maps     maps that are the same everywhere, stored as one number
"""
