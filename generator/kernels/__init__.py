"""Compiled and torch loops that draw frames and project thicknesses."""
