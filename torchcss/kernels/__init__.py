"""Compiled kernels: Python that numba compiles, how, and where it is kept; knows nothing else."""
