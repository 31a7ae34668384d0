"""Fusion of depth maps into a signed distance field."""
