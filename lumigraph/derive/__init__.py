"""A run becomes another run: of another method, smaller, or aligned with others of its category."""
