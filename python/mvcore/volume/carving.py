"""Space carving under one name, `mvcore.carve`: silhouettes, the visual hull, photo-consistency."""

from ..silhouettes.visual_hull import Occupancy, bounded_hull, carve_silhouettes, shadow, supported
from .photo_hull import photo_hull, visual_hull

__all__ = ["Occupancy", "bounded_hull", "carve_silhouettes", "photo_hull", "shadow", "supported", "visual_hull"]
