"""A mosaic of pictures: which belong together, where each lies, and one picture of all."""
