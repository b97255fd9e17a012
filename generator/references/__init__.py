"""From measured images to other settings: what noise they lack, and which materials they show.

Files:
    topup                 the noise that a reference lacks at a shorter exposure
    transfer              a reference pair at another kV or filter
    two_material          path lengths of two materials from images at two kV
    as_published          the paper's recipe, kept as a baseline
    _two_material_loops   tables and Newton's method, compiled
"""
