"""A camera found by gradients: a field renders what a pose would see, and the error moves the pose (Lin 2021, iNeRF).

Rays are functions of the pose, so the loss of a picture is one as well. A rotation has no sum, but it has an
exponential: three numbers omega, whatever they are, give a rotation, and around zero they add up.
"""

import time

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .camera import pinhole_rays
from .data import photographs, psnr, save
from .hashgrid import field, picture, render, train
from .nerf import rays_of

FIELD_STEPS, STEPS, RAYS, RATE = 300, 150, 512, 6e-3
TURN, SHIFT = 5.0, 0.12  # the error to undo: degrees, scene units


def exponential(omega: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """Rotation about omega by |omega| radians: exp(K) = I + sin(a) / a K + (1 - cos a) / a^2 K^2 (Rodrigues).

    K x = omega x x. Near zero the fractions tend to 1 and 1/2, and the gradient to that of I + K.
    """
    x, y, z = omega
    zero = torch.zeros_like(x)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    a = (omega @ omega).clamp_min(1e-12).sqrt()
    return torch.eye(3) + a.sin() / a * K + (1 - a.cos()) / a**2 * K @ K


def moved(pose: Float[Tensor, "3 4"], twist: Float[Tensor, " 6"]) -> Float[Tensor, "3 4"]:
    """The pose turned about its own position, then shifted: R' = exp(omega) R, o' = o + v."""
    return torch.cat([exponential(twist[:3]) @ pose[:, :3], (pose[:, 3] + twist[3:])[:, None]], 1)


def angle(a: Float[Tensor, "3 4"], b: Float[Tensor, "3 4"]) -> float:
    """Degrees between two rotations: trace(A^T B) = 1 + 2 cos."""
    return float(torch.rad2deg(((torch.trace(a[:, :3].T @ b[:, :3]) - 1) / 2).clamp(-1, 1).acos()))


def find(net, occupied: Tensor, image: Tensor, pose: Tensor, focal: float, truth: Tensor, steps: int = STEPS) -> Tensor:
    """The twist that makes the field look like the photograph, from zero: Adam over six numbers."""
    twist = torch.zeros(6, requires_grad=True)
    optimizer, begin = torch.optim.Adam([twist], RATE, betas=(0.9, 0.9)), time.perf_counter()
    near = -nn.functional.max_pool2d(-image.amin(2)[None], 9, 1, 4)[0]  # the darkest pixel around each
    interesting = (near < 0.97).flatten().nonzero()[:, 0]  # a white pixel amid white ones says nothing
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = RATE * 0.03 ** (step / steps)
        chosen = interesting[torch.randint(len(interesting), (RAYS,))]
        o, d = pinhole_rays(image, moved(pose, twist), focal)
        loss = (render(net, o[chosen], d[chosen], occupied)[0] - image.view(-1, 3)[chosen]).square().mean()
        twist.grad = torch.autograd.grad(loss, twist)[0]
        optimizer.step()
        if step % 20 == 0 or step == steps - 1:
            now = moved(pose, twist.detach())
            off = f"{angle(now, truth):5.2f} degrees   {(now[:, 3] - truth[:, 3]).norm():.4f} scene units"
            print(f"step {step:4}   {time.perf_counter() - begin:4.0f} s   loss {loss.item():.4f}   {off}")
    return twist.detach()


def main() -> None:
    torch.manual_seed(0)
    net = field()
    occupied = train(net, *rays_of(*photographs()), steps=FIELD_STEPS)
    for parameter in net.parameters():
        parameter.requires_grad_(False)  # the scene is known; the camera is not
    images, poses, focal = photographs("test")
    image, truth = images[1], poses[1]
    axis = torch.nn.functional.normalize(torch.randn(2, 3), dim=1)
    wrong = moved(truth, torch.cat([TURN * torch.pi / 180 * axis[0], SHIFT * axis[1]]))
    right = moved(wrong, find(net, occupied, image, wrong, focal, truth))
    shown = [picture(net, occupied, image, pose, focal) for pose in (wrong, right)]
    print(f"{psnr(shown[0], image):.1f} dB before, {psnr(shown[1], image):.1f} dB after")
    save("pose", image, *shown, *(0.5 + (x - image) for x in shown))


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/components/training/pose_refinement.py` corrects all cameras while the scene is learnt,
# coarse to fine (BARF), in coordinates in which each direction moves the picture equally far (CamP).
# `components/tracking/` follows a depth camera by second-order steps, and `sfm/` needs no pose to begin with.
