"""Procedural scenes with exact truth, on which the network is trained."""
