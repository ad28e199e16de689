"""Training: optimizers, schedules, losses, pose refinement, exposures of photographs."""
