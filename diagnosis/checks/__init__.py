"""Before effects compete: do the series show what their labels say, and with which twin are they compared?

Files:
    preparation      series that are left out, the twin, where its spectrum is taken as linear
    plausibility     all checks of labels, in order
    readings         label, mean frame and noise of each series
    beam_suspects    beam on or off, field empty or not
    map_suspects     thickness maps that do not fit the shadow
    label_suspects   another kV, filter, load or exposure than stated
    label_model      what labels let expect
"""
