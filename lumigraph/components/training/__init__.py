"""How methods learn: optimizers, schedules, losses, corrections of what photographs say."""
