"""Multi-view video."""
