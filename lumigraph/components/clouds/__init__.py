"""Points and flat views of photographs with known cameras."""
