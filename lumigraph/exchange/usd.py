"""Clouds in OpenUSD as ParticleField3DGaussianSplat (schema of OpenUSD 26.03), which is written and not read.

The stage has y up, so all is turned half around x, as in glTF. Numbers are float32: positions, scales without
logarithm, opacities after the sigmoid, quaternions, and (degree + 1)^2 spherical harmonics to a Gaussian with the
constant first, whose colour is 1/2 + sum, sRGB-encoded, as in the first release. `antialiased` is in customData.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import LumigraphError
from ..files import write_bytes
from ..gaussians import Gaussians
from ..kernels.spherical_harmonics import K00
from .codes import TURN_HARMONICS, TURN_MEAN, TURN_ROTATION, array, to_scales, unit

SUFFIXES = (".usdc", ".usda", ".usd")
REACH = 3.0  # deviations of a Gaussian within the extent


def write(path: Path, gaussians: Gaussians, offset: Float[np.ndarray, " 3"] | None = None) -> None:
    """Write a layer, binary for .usdc and .usd. Raises LumigraphError without usd-core.

    offset: translation of the cloud's parent, which is added to the centres
    """
    try:
        from pxr import Gf, Usd, UsdGeom, UsdVol, Vt
    except ImportError as fault:
        raise LumigraphError(
            f"{path} needs usd-core to be written; install it: pip install 'lumigraph[usd]', or write .glb"
        ) from fault
    means = (array(gaussians.means) * TURN_MEAN).astype(np.float32)
    scales = to_scales(array(gaussians.log_scales)).astype(np.float32)
    harmonics = (array(gaussians.harmonics) * TURN_HARMONICS[: gaussians.harmonics.shape[1]]).astype(np.float32)
    rotations = np.roll(unit(array(gaussians.quaternions)) * TURN_ROTATION, -1, -1).astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"cloud{path.suffix.lower()}"
        stage = Usd.Stage.CreateNew(str(file))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        parent = UsdGeom.Xform.Define(stage, "/World")
        stage.SetDefaultPrim(parent.GetPrim())
        if offset is not None:
            parent.AddTranslateOp().Set(Gf.Vec3d(*(offset * TURN_MEAN).tolist()))
        cloud = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/World/Gaussians")
        prim = cloud.GetPrim()
        values = {
            "positions": Vt.Vec3fArray.FromNumpy(means),
            "scales": Vt.Vec3fArray.FromNumpy(scales),
            "orientations": Vt.QuatfArray.FromNumpy(rotations),
            "opacities": Vt.FloatArray.FromNumpy(gaussians.opacities.sigmoid().detach().cpu().float().numpy()),
            "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(harmonics.reshape(-1, 3)),
            "radiance:sphericalHarmonicsDegree": gaussians.degree,
            "primvars:displayColor": Vt.Vec3fArray.FromNumpy(np.clip(K00 * harmonics[:, 0] + 0.5, 0, 1)),
        }
        for name, value in values.items():
            prim.GetAttribute(name).Set(value)
        UsdGeom.PrimvarsAPI(prim).GetPrimvar("displayColor").SetInterpolation(UsdGeom.Tokens.vertex)
        if len(means):
            reach = REACH * scales.max(1, keepdims=True)
            corners = (means - reach).min(0), (means + reach).max(0)
            cloud.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack(corners)))
        prim.SetCustomDataByKey("antialiased", gaussians.antialiased)
        stage.GetRootLayer().Save()
        write_bytes(path, file.read_bytes(), "splats")
