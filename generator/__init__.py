"""raytwin.generator"""
