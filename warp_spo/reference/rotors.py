"""Rotors of geared motors in the specification: what each adds to the dense matrices, in world axes.

A rotor is a rigid body on the parent of its hinge that turns against it by ratio times the hinge's first coordinate.
One whose parent no hinge can move only spins.
"""

import numpy as np

from .rotations import cross


def moving(dense):
    """Return whether some hinge moves the body [body + 1]; the last is the inertial frame."""
    moves = np.zeros(dense.body_count + 1, dtype=bool)
    for k in dense.outward:
        moves[k] = moves[dense.parent[k]] or len(dense.dofs[k]) > 0
    return moves


class Rotors:
    """The rotors of a scene at the configuration of a :class:`.dense.Dense`; reflected ones are armature.

    Attributes:
        hinges: of each rotor (parent, dof, axis in the world, ratio).
        matter: of each (mass, centre of mass, inertia about it, Jacobian of it and of the turn [6, dof]), in the world.
    """

    def __init__(self, dense):
        self.dense, self.hinges, self.matter = dense, [], []
        for k, hinge in enumerate(dense.hinge):
            rotor = getattr(hinge, "rotor", None)
            if rotor is None or rotor.model == "reflected":
                continue
            parent, dof, anchor = dense.parent[k], dense.dofs[k][0], dense.stages[k][0]
            turn = anchor[:3, :3]
            mass, com, u = rotor.mass, turn @ rotor.com + anchor[:3, 3], turn @ rotor.axis
            inertia = turn @ rotor.matrix @ turn.T
            J = np.zeros((6, dense.dof_count)) if parent < 0 else dense._jacobian_at(parent, com)
            if not dense.moves[parent]:
                mass, inertia = 0.0, (u @ inertia @ u) * np.outer(u, u)
            J[3:, dof] += rotor.ratio * u
            self.hinges.append((parent, dof, u, rotor.ratio))
            self.matter.append((mass, com, inertia, J))

    @property
    def momenta(self):
        """List the Jacobian, and the momentum per unit qd [6, dof], of each rotor."""
        return [(J, np.concatenate([mass * J[:3], inertia @ J[3:]])) for mass, _, inertia, J in self.matter]

    def efforts(self, qd, qdd, motion):
        """Return for each rotor m a, then I alpha + omega x I omega [6]; ``motion`` as Dense._motion returns it."""
        found = []
        for (parent, dof, u, ratio), (mass, com, inertia, _) in zip(self.hinges, self.matter, strict=True):
            w, a, al = np.zeros((3, 3))
            if parent >= 0:
                w, al, r = motion[0][parent], motion[3][parent], com - self.dense.node_matrix[parent][:3, 3]
                a = motion[2][parent] + cross(al, r) + cross(w, cross(w, r))
            spin = ratio * qd[dof] * u
            al, w = al + ratio * qdd[dof] * u + cross(w, spin), w + spin
            found.append(np.concatenate([mass * a, inertia @ al + cross(w, inertia @ w)]))
        return found
