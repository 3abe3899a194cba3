"""A mosaic that grows with a stream: what is painted, kept, painted again and written."""
