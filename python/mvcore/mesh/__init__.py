"""From the field to a textured mesh."""
