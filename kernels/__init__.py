"""Warp kernels and native functions. Imports warp and nothing else."""
