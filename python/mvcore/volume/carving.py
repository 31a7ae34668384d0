"""Space carving under one name, `mvcore.carve`: silhouettes, the visual hull, photo-consistency."""

from ..silhouettes.visual_hull import Occupancy, carve_silhouettes, shadow, supported, bounded_hull
from .photo_hull import photo_hull, visual_hull

__all__ = ["Occupancy", "carve_silhouettes", "photo_hull", "shadow", "supported", "bounded_hull", "visual_hull"]
