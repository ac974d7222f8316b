"""Measurements, one file per subject: python -m benchmarks NAME."""
