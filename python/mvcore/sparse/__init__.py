"""Sparse points: where to search, and whether the calibration fits."""
