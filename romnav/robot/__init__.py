"""Two dynamics behind one interface: the reduced-order model and the humanoid."""
