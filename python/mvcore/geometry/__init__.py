"""Cameras, epipolar geometry and registration."""
