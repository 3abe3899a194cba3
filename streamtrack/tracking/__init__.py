"""Following one target: `tracker` reads as the method, the other files are its stages."""
