"""Track objects and build mosaics from video."""
