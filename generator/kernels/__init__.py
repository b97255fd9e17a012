"""Compiled and torch loops that draw frames and project thicknesses.

Files:
    kernels              noisy frames, reproducible on processor and GPU
    projection           rays through materials, summed over energies
    _frames              what is asked of the noise of frames
    _noise_constants     numbers that both kernels of the noise share
    _numba_kernels       the noise, compiled
    _torch_kernels       the noise in torch
    _projection_kernel   the sum over energies, compiled
"""
