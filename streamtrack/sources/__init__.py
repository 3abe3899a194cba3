"""Sources of frames: `open_source` opens any of them."""
