"""Numbers of a twin at a setting: flatfield, dose, contrast.

Files:
    predict            flatfield at a setting, with its interval
    predict_many       level and noise at thousands of settings, without intervals
    predict_settings   settings as objects, texts or words
    contrast           contrast of a foreign object and its noise, before any image
    dual_layer         the second layer of a dual-layer panel
    tube_twin          a tube calibrated with a dosimeter alone
"""
