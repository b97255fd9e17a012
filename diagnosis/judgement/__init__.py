"""Which explanation leads, how well it fits, how strong each effect is, and the answer."""
