"""raytwin.acquisition"""
