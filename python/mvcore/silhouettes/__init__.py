"""Silhouettes: found in images, and the visual hull they bound."""
