"""Structure from motion: where bare photographs were taken from."""
