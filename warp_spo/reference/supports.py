"""The specification of how the path of a point bends that moves over its shape, in inertial axes."""

import numpy as np


def support_path(support, turn, up, w, change):
    """Return the material point whose path counts, from the shape's middle, and by how much more the point rises.

    The lowest point of an ellipsoid is f = |A n| below the middle, with A the half axes and n the plane's normal in the
    body; that changes by f'' as n' = n x w does. A point on a rim turns as the cylinder's axis does, without the part
    of ``w`` about it. Corners of boxes and hulls are material points.

    Args:
        turn: of the body [3, 3]. up: the ground's normal. w, change: angular velocity and acceleration (3,).
    """
    offset = turn @ support.offset(turn.T @ up)
    axes, sizes = np.array(support.axes) @ turn.T, np.array(support.sizes)
    if support.kind in ("corner", "hull corner"):
        return offset, 0.0
    if support.kind == "rim":
        hub = axes[2] * (axes[2] @ offset)
        spoke, about = offset - hub, w - axes[2] * (axes[2] @ w)
        return hub, up @ (np.cross(change, spoke) + np.cross(about, np.cross(about, spoke)))
    A = sizes[:, None] * axes
    first = np.cross(up, w)
    u, du, ddu = A @ up, A @ first, A @ (np.cross(first, w) + np.cross(up, change))
    f = np.linalg.norm(u)
    return np.zeros(3), -(du @ du + u @ ddu - (u @ du / f) ** 2) / f
