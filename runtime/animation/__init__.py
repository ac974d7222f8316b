"""Skeletons, clips and poses of many actors at once, in NumPy alone."""
