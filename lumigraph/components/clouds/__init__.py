"""Parts of Gaussian splatting methods, and dense points from photographs."""
