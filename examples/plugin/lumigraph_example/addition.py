"""Small splats: a penalty on the size of Gaussians."""

from lumigraph.components.clouds.addition import Addition

WEIGHT = 0.1  # of the mean standard deviation, scene units


class SmallSplats(Addition):
    """A term of the loss; further hooks are in `Addition`."""

    def __init__(self, frame):
        super().__init__()

    def regularize(self, step):
        step.terms["small"] = WEIGHT * step.cloud.log_scales.exp().mean()
