"""Laboratory: comparisons of methods, and measured equations of papers on the user's data."""
