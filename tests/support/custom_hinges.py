"""Custom hinges for tests: joints of the body, and built-in hinges written as functions."""

import numpy as np

import warp_spo as spo

from . import zoo

RADIUS = 0.04  # of the condyle [m]
KNOTS = (-1.5, -0.7, -0.2, 0.4, 1.0, 1.6)  # of the spline knee [rad]
AHEAD = spo.spline(KNOTS, (0.02, 0.035, 0.03, 0.012, -0.01, -0.025))  # [m]
ABOVE = spo.spline(KNOTS, (0.41, 0.405, 0.4, 0.398, 0.403, 0.41))  # [m]
AXES = (0.02, 0.03, 0.025)  # of the ellipsoid [m]


def about(axis, angle):
    """Rotation matrix about the frame's axis 0, 1 or 2, of a scalar of any kind."""
    c, s, one = np.cos(angle), np.sin(angle), np.eye(3).astype(object)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    one[j, j], one[j, k], one[k, j], one[k, k] = c, -s, s, c
    return one


def rolling_knee(q):
    """A condyle that rolls on a plane: its centre moves as far as it turns."""
    return (-RADIUS * q[0], 0.0, 0.0), about(2, q[0])


def spline_knee(q):
    """A knee whose centre wanders with the flexion, as splines through measured points say."""
    return (AHEAD(q[0]), ABOVE(q[0]), 0.0), about(2, q[0]) @ about(0, 0.1 * np.sin(q[0]))


def ellipsoid_shoulder(q):
    """A scapula that slides and turns on an ellipsoid: OpenSim's elevation, abduction, upward rotation."""
    R = about(1, q[0]) @ about(0, q[1]) @ about(2, q[2])
    return np.array(AXES) * R[:, 2], R


def many_functions(q):
    """All that a pose may be written with."""
    a, b = q
    bent = spo.where((a < 0.3) & ~(b > 2.0), a * a, 0.3 * a + abs(a) ** 1.5 - abs(0.3) ** 1.5)
    far = np.hypot(a, 2.0) + np.sqrt(1.5 + b) / (2.0 + np.exp(-a)) - np.log(3.0 + b) ** 2
    angle = np.arctan2(np.sin(b), 2.0 + np.cos(a)) + 0.1 * np.tan(0.5 * a) + spo.clip(b, -0.4, 5.0) ** 3
    return (0.1 * bent, 2.0**a - 1.0, 0.05 * far), about(0, angle) @ about(1, a)


POSES = {
    "rolling_knee": (rolling_knee, 1),
    "spline_knee": (spline_knee, 1),
    "ellipsoid_shoulder": (ellipsoid_shoulder, 3),
    "many_functions": (many_functions, 2),
}


def custom(rng, name, parent, child):
    """A custom hinge with random anchors and laws."""
    pose, n = POSES[name]
    laws = dict(armature=rng.uniform(0.01, 0.2, n), damping=rng.uniform(0.0, 1.0, n), stiffness=rng.uniform(0, 5, n))
    laws |= dict(parent_pose=zoo.random_pose(rng), child_pose=zoo.random_pose(rng, 0.2))
    return spo.Hinge.custom(parent, child, coordinates=n, pose=pose, label=name, **laws)


def skeleton(seed=70, names=tuple(POSES)):
    """A floating body and, between a ball, a revolute and a helical hinge, custom ones; another on the ground."""
    rng = np.random.default_rng(seed)
    bodies = [zoo.random_body(rng) for _ in range(5 + len(names))]
    hinges = [zoo.random_hinge(rng, "free", -1, 0)]
    hinges += [zoo.random_hinge(rng, kind, 0, k) for k, kind in ((1, "ball"), (2, "revolute"), (3, "helical"))]
    hinges += [custom(rng, name, k % 4, 4 + k) for k, name in enumerate(names)]
    hinges.append(custom(rng, names[0], -1, 4 + len(names)))
    return spo.Scene(bodies, [hinges[k] for k in rng.permutation(len(hinges))], gravity=rng.uniform(-9.81, 9.81, 3))


def written_out(hinge):
    """A chain of screws as a custom hinge."""

    def pose(q):
        position, R = np.zeros(3), np.eye(3)
        for (axis, angular, linear), x in zip(hinge.screws, q, strict=True):
            position = position + R @ axis * (linear * x)
            k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
            angle = angular * x
            R = R @ (np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)) if angular else R
        return position, R

    names = ("armature", "damping", "friction", "stiffness", "target_ke", "target_kd", "limit_lower", "limit_upper")
    names += ("limit_ke", "limit_kd", "effort_limit", "velocity_limit", "rest", "parent_pose", "child_pose", "label")
    given = {name: getattr(hinge, name) for name in names}
    return spo.Hinge.custom(hinge.parent, hinge.child, coordinates=hinge.dof_count, pose=pose, **given)


def twins(seed=71):
    """A scene of built-in hinges, and the same with its chains of screws as custom hinges."""
    d6 = [(3, 3)]
    scene = zoo.from_parents([-1, 0, 1, 0, 3, 2], ["free", "revolute", "universal", "d6", "ball", "helical"], seed,
                             d6_axes=d6)  # fmt: skip
    hinges = [hinge if hinge.kind in ("free", "ball") else written_out(hinge) for hinge in scene.hinges]
    return scene, spo.Scene(scene.bodies, hinges, gravity=scene.values["gravity"][0])
