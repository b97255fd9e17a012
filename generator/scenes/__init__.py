"""Products and foreign objects that a description names, and the path lengths of rays through them."""
