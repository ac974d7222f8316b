"""Seam-aware edge collapse."""
