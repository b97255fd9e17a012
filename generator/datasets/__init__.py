"""Dual-energy images with masks, from references, descriptions or known path lengths.

Files:
    generate             images from references
    generate_described   images from a description
    known_scenes         images of objects whose path lengths are known
    reference_materials  what the objects of references are made of
    render               transmission and quantum variance of a scene
    image_effects        effects in single images
    belt_motion          the motion that a belt makes in images
    fresh                images with new noise at every look
"""
