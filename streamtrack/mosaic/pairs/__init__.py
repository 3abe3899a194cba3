"""How two pictures lie to each other, and whether that may be believed."""
