"""Painters: textures drawn from seeded random numbers, and the scenes made of them."""
