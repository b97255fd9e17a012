"""raytwin.segmentation"""
