"""raytwin.calibration"""
