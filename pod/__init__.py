"""raytwin.pod"""
