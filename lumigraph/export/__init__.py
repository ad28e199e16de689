"""What leaves the house: films. Exporters know how a Method renders, and no particular method."""
