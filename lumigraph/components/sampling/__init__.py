"""Where along rays to look: spaces, samplers, and what is known to be empty."""
