"""Where light and noise spread to.

Files:
    psf             optical spread, its share of the variance, the noise correlation it leaves
    spot            image of a focal spot
    noise           noise of one frame, drawn in its physical order
    registration    shift between two pictures
    _fine_picture   sharp borders of objects on a grid finer than the pixels
"""
