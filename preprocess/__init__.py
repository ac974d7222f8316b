"""Offline step: erases seams, straightens them and builds levels of detail for a textured, skinned character."""
