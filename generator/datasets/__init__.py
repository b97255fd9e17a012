"""Dual-energy images with masks, from references, descriptions or known path lengths."""
