"""Erasure near seams alone, as a build does it: a band of texels, solved without a factor of the whole system."""
