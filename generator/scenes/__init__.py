"""Products and foreign objects that a description names, and the path lengths of rays through them.

Files:
    describe      a description (TOML), and scenes drawn from it
    kinds         kinds of objects: parameters, and how one is drawn
    shapes        path lengths through shapes
    mesh          closed meshes of triangles
    _mesh_loops   path lengths through meshes, compiled
"""
