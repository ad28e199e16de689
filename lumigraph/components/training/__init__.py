"""Training: optimizers, schedules, losses, refinement of poses, exposures of photographs."""
