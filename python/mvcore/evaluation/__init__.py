"""Figures of a result against truth."""
