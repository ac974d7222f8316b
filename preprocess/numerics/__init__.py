"""Sparse solvers and compiled kernels: what knows of no mesh."""
