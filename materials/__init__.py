"""raytwin.materials"""
