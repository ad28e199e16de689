"""What two or more methods share: occupancy, perceptrons, optimizers, corrections of exposure and pose."""
