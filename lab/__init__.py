"""raytwin.lab"""
