"""What methods are made of, by theme: fields, sampling along rays, clouds of Gaussians, training."""
