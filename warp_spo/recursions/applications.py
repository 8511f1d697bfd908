"""The paper's applications as traces: operations that have no other form than a kernel of their scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..trace.emission import Store
from ..trace.scalars import Value, reciprocal, sqrt
from ..trace.spatial import ZERO, Articulated, Rigid, Vector, cross, dot
from . import articulated, composite, determinant, hybrid, motion, newton_euler, reactions, step
from .hybrid import Given
from .links import Link
from .loops import closed_step
from .motion import STILL
from .operators import Operators
from .traced import Trace


def at_rest(dof: int) -> Value:
    """qdd = 0"""
    return 0.0


class Applications(Trace):
    """The operations of :class:`Trace`, and those beyond them."""

    def expression(self, expression: Any) -> list[Store]:
        """out = an operator, or what is composed of several, times the array x; see :mod:`.operators`."""
        return Operators(self).stores(expression)

    # -- time steps ------------------------------------------------------------------------------------------------
    def step(self, qdd: bool = False, status: bool = False, how: Any = None) -> list[Store]:
        """out = qd', q_out = q', qdd_out, status; ``how`` loops are embedded, see :class:`.embedded.Embedding`."""
        if "multipliers" in self.given:
            return closed_step.MultiplierStep(self).stores(qdd, status)
        which = step.Step(self) if how is None else closed_step.ClosedStep(self, how)
        return which.stores(qdd, status)

    def step_system(self) -> list[Store]:
        """What the multipliers of a step solve; as :meth:`.multipliers.Multipliers.loop_system`."""
        return closed_step.MultiplierStep(self).system()

    def integrate(self) -> list[Store]:
        return step.integrate(self)

    def coordinate_rates(self) -> list[Store]:
        return step.rates(self)

    def passive_force(self) -> list[Store]:
        return step.passive_force(self)

    def hinge_force(self) -> list[Store]:
        return step.hinge_force(self)

    def body_accelerations(self) -> list[Store]:
        return reactions.body_accelerations(self)

    def body_reactions(self) -> list[Store]:
        return reactions.body_reactions(self)

    # -- hybrid dynamics -------------------------------------------------------------------------------------------
    def hybrid_dynamics(self, held: tuple[bool, ...] | None = None) -> list[Store]:
        """out = qdd, tau_out = tau: dofs under the mask follow qdd, the others tau.

        Args:
            held: the mask, if it is constant; otherwise the array "prescribed" is it.
        """
        mask = self.vector("prescribed") if held is None else lambda dof: float(held[dof])
        tau, qdd, moves = self.vector("tau"), self.vector("qdd"), "qd" in self.given
        given: dict[int, Given] = {}
        done: dict[int, articulated.Factor] = {}
        rates: dict[int, list[Value]] = {}
        heads: dict[int, list[Value]] = {}
        inner: dict[int, Articulated] = {}
        forces: dict[int, Vector] = {}
        for link, outward in self.traversal():
            key = id(link)
            if outward:
                self.place(link, moves)
                continue
            self.at(link, "P")
            place, move = self.places[key], self.motions[key]
            carried = [inner[id(child)] for child in link.children]
            through = [(self.places[id(child)].pose, done[id(child)].P) for child in link.children]
            given[key] = known = Given(*([entry(dof) for dof in link.dofs] for entry in (mask, tau, qdd)))
            if known.free:
                done[key] = articulated.factor(link, place, carried, through, self.epsilon)
            else:
                done[key] = hybrid.factor(link, place, known.mask, carried, through, self.epsilon)
            inner[key] = done[key].in_parent
            self.at(link, "z")
            z = articulated.gyroscopic(link.inertia, move) - self.external(link)
            for child in link.children:
                z = z + forces[id(child)]
            if known.free:
                rates[key], forces[key] = articulated.reduced(link, place, done[key], move, z, known.tau)
            else:
                rates[key], heads[key], forces[key] = hybrid.reduced(link, place, done[key], move, z, known)
        alpha: dict[int, tuple[Vector, Vector]] = {}
        stores: list[Store] = []
        for link in self.links.links:
            self.at(link, "a")
            key = id(link)
            above = self.base if link.parent is None else alpha[id(link.parent)]
            known, place, move = given[key], self.places[key], self.motions[key]
            if known.free:
                forward, alpha[key] = articulated.expanded(link, place, done[key], rates[key], move, above)
                inverse = known.tau
            else:
                forward, inverse, alpha[key] = hybrid.expanded(
                    link, place, done[key], rates[key], heads[key], move, above, known
                )
            for dof, a, force in zip(link.dofs, forward, inverse, strict=True):
                stores += [Store("out", (dof,), a), Store("tau_out", (dof,), force)]
        return stores

    # -- kinematics ------------------------------------------------------------------------------------------------
    def place_all(self, moves: bool = False) -> dict[int, Vector]:
        """Place every link and find its axes; its origin in inertial axes, from the origin of the first root's link."""
        origins: dict[int, Vector] = {}
        for link in self.links.links:
            self.place(link, moves)
            self.at(link, "R")
            key, pose = id(link), self.places[id(link)].pose
            if link.parent is None:
                self.axes[key] = pose.rotation
                first = self.places[id(self.links.links[0])].pose.l
                origins[key] = pose.l - first if origins else ZERO  # what is far away cancels once
            else:
                over = id(link.parent)
                self.axes[key] = self.axes[over] @ pose.rotation
                origins[key] = origins[over] + self.axes[over] @ pose.l
        return origins

    def link_accelerations(self, qdd: Callable[[int], Value]) -> dict[int, tuple[Vector, Vector]]:
        """Accelerations of the links without gravity: phi* (H* qdd + a)."""
        alpha: dict[int, tuple[Vector, Vector]] = {}
        for link in self.links.links:
            self.at(link, "a")
            above = (ZERO, ZERO) if link.parent is None else alpha[id(link.parent)]
            place, move = self.places[id(link)], self.motions[id(link)]
            alpha[id(link)] = newton_euler.accelerated(link, place, move, above, qdd)
        return alpha

    def jacobian_bias(self, frames: tuple) -> list[Store]:
        """out [frame, 6] = J' qd: acceleration of each frame's origin, angular acceleration, inertial axes, qdd = 0."""
        self.place_all(moves=True)
        return self._at_frames(frames, self.link_accelerations(at_rest))

    def frame_accelerations(self, frames: tuple) -> list[Store]:
        """out [frame, 6] = J qdd + J' qd"""
        self.place_all(moves="qd" in self.given)
        return self._at_frames(frames, self.link_accelerations(self.vector("qdd")))

    def _at_frames(self, frames: tuple, alpha: dict[int, tuple[Vector, Vector]]) -> list[Store]:
        """out [frame, 6]: how frames accelerate whose links do as ``alpha`` says, inertial axes."""
        stores = []
        for index, (body, origin) in enumerate(frames):
            link, arm = self.frame(body, origin)
            values = (*ZERO, *ZERO)
            if link is not None:
                self.at(link, f"j{index}_")
                (w, v), R = alpha[id(link)], self.axes[id(link)]
                values = (*(R @ (v + cross(w, arm) + self.motions[id(link)].whirl @ arm)), *(R @ w))
            stores += [Store("out", (index, c), value) for c, value in enumerate(values)]
        return stores

    def operational_inertia_inverse_product(self, frames: tuple) -> list[Store]:
        """out [frame, 6] = J Mass^-1 J* x: wrenches x on the frames inward, the accelerations that they make outward"""
        self.place_all()
        done = self.factor()
        forces: dict[int, Vector] = {id(link): Vector((*ZERO, *ZERO)) for link in self.links.links}
        for key, wrench in self.pushed(frames).items():
            forces[key] = forces[key] - wrench
        rates: dict[int, list[Value]] = {}
        for link in reversed(self.links.links):
            self.at(link, "z")
            key, still = id(link), [0.0] * len(link.dofs)
            rates[key], force = articulated.reduced(link, self.places[key], done[key], STILL, forces[key], still)
            if link.parent is not None:
                forces[id(link.parent)] = forces[id(link.parent)] + force
        alpha: dict[int, tuple[Vector, Vector]] = {}
        for link in self.links.links:
            self.at(link, "a")
            above = (ZERO, ZERO) if link.parent is None else alpha[id(link.parent)]
            _, alpha[id(link)] = articulated.expanded(
                link, self.places[id(link)], done[id(link)], rates[id(link)], STILL, above
            )
        return self._at_frames(frames, alpha)

    def pushed(self, frames: tuple) -> dict[int, Vector]:
        """(n; f) by link, in its frame, of the wrenches x on the frames; after the links are placed."""
        x, found = self.vector("x"), dict[int, Vector]()
        for index, (body, origin) in enumerate(frames):
            link, arm = self.frame(body, origin)
            if link is not None:
                self.at(link, f"x{index}_")
                back = self.axes[id(link)].T
                f, n = (back @ Vector(x(6 * index + 3 * part + c) for c in range(3)) for part in range(2))
                wrench = Vector((*(n + cross(arm, f)), *f))
                found[id(link)] = found[id(link)] + wrench if id(link) in found else wrench
        return found

    # -- momentum --------------------------------------------------------------------------------------------------
    def composites(self) -> dict[int, Rigid]:
        """R(k) of every placed link: the rigid inertia of all that it carries, in its frame."""
        found: dict[int, Rigid] = {}
        for link in reversed(self.links.links):
            self.at(link, "R")
            body = link.inertia or composite.NOTHING
            for child in link.children:
                body = body + self.places[id(child)].pose.rigid_to_parent(found[id(child)])
            found[id(link)] = body
        return found

    def center(self, bodies: dict[int, Rigid], origins: dict[int, Vector]) -> tuple[Value, Vector]:
        """1 / mass, and the CoM of all that moves, inertial axes, from the origin of the first root's link."""
        self.graph.step = "whole|c"
        mass: Value = 0.0
        moment = ZERO
        for link in self.links.links:
            if link.parent is None:
                body = bodies[id(link)]
                mass = mass + body.mass
                moment = moment + self.axes[id(link)] @ body.moment + origins[id(link)] * body.mass
        inverse = reciprocal(mass)
        return inverse, moment * inverse

    def momenta(self, link: Link, body: Rigid) -> list[tuple[Vector, Vector]]:
        """(n; f) = R(k) H* of each dof of a link, inertial axes, about the link's origin."""
        R, found = self.axes[id(link)], []
        for H in articulated.columns(link, self.places[id(link)]):
            n, f = body.apply(Vector(H[:3]), Vector(H[3:]))
            found.append((R @ n, R @ f))
        return found

    def com_jacobian(self) -> list[Store]:
        """out [3, dof] = linear momentum per unit qd over the mass"""
        origins, bodies = self.place_all(), self.composites()
        inverse, _ = self.center(bodies, origins)
        stores = []
        for link in self.links.links:
            self.at(link, "j")
            for dof, (_, f) in zip(link.dofs, self.momenta(link, bodies[id(link)]), strict=True):
                stores += [Store("out", (c, dof), value * inverse) for c, value in enumerate(f)]
        return stores

    def centroidal_momentum_matrix(self) -> list[Store]:
        """out [6, dof] = linear momentum, angular momentum about the CoM, inertial axes, per unit qd"""
        origins, bodies = self.place_all(), self.composites()
        _, c = self.center(bodies, origins)
        stores = []
        for link in self.links.links:
            self.at(link, "h")
            arm = origins[id(link)] - c
            for dof, (n, f) in zip(link.dofs, self.momenta(link, bodies[id(link)]), strict=True):
                stores += [Store("out", (i, dof), value) for i, value in enumerate((*f, *(n + cross(arm, f))))]
        return stores

    def centroidal_momentum_bias(self, qdd: Callable[[int], Value] = at_rest) -> list[Store]:
        """out [6] = A qdd + A' qd: the force and the moment about the CoM that the motion takes, without gravity"""
        origins = self.place_all(moves=True)
        alpha, bodies = self.link_accelerations(qdd), self.composites()
        _, c = self.center(bodies, origins)
        forces: dict[int, Vector] = {}
        n, f = ZERO, ZERO
        for link in reversed(self.links.links):
            self.at(link, "f")
            key = id(link)
            force = Vector((*ZERO, *ZERO))
            if link.inertia is not None:
                force = newton_euler.body_force(link.inertia, self.motions[key], *alpha[key])
            for child in link.children:
                n_c, f_c = Vector(forces[id(child)][:3]), Vector(forces[id(child)][3:])
                n_c, f_c = self.places[id(child)].pose.force_to_parent(n_c, f_c)
                force = force + Vector((*n_c, *f_c))
            forces[key] = force
            if link.parent is None:
                f_r = self.axes[key] @ Vector(force[3:])
                n, f = n + self.axes[key] @ Vector(force[:3]) + cross(origins[key] - c, f_r), f + f_r
        return [Store("out", (i,), value) for i, value in enumerate((*f, *n))]

    # -- the factors' other uses -----------------------------------------------------------------------------------
    def factor_by_dofs(self) -> dict[int, articulated.Factor]:
        """Factors of every link in the coordinates of qd: Mass = U D U*, U unit upper triangular, parents first."""
        done: dict[int, articulated.Factor] = {}
        for link, outward in self.traversal():
            if outward:
                self.place(link)
                continue
            self.at(link, "P")
            carried = [done[id(child)].in_parent for child in link.children]
            through = [(self.places[id(child)].pose, done[id(child)].P) for child in link.children]
            free = [0.0] * len(link.dofs)
            done[id(link)] = hybrid.factor(link, self.places[id(link)], free, carried, through, self.epsilon)
        return done

    def quasi_velocities(self) -> list[Store]:
        """out = sqrt(D) [I + H phi K]* qd"""
        qd, done = self.vector("qd"), self.factor_by_dofs()
        velocity: dict[int, Vector] = {}
        stores = []
        for link in self.links.links:
            self.at(link, "v")
            key, V = id(link), Vector((*ZERO, *ZERO))
            if link.parent is not None:
                above = velocity[id(link.parent)]
                w, v = self.places[key].pose.motion_to_child(Vector(above[:3]), Vector(above[3:]))
                V = Vector((*w, *v))
            for dof, pivot in zip(link.dofs, done[key].pivots[::-1], strict=True):
                eta = qd(dof) + pivot.inverse * dot(pivot.U, V)
                stores.append(Store("out", (dof,), sqrt(pivot.D) * eta))
                V = V + pivot.column * qd(dof)
            velocity[key] = V
        return stores

    def log_det_mass_matrix_gradient(self, scale: float = 1.0) -> list[Store]:
        """out = d log det Mass / dq, dual to qd"""
        done = self.factor()
        carried: dict[int, Articulated] = {}
        stores = []
        for link in self.links.links:
            self.at(link, "u")
            key, factor = id(link), done[id(link)]
            place = self.places[key]
            S = articulated.NO_INERTIA
            if link.parent is not None:
                S = determinant.to_child(place.pose, carried[id(link.parent)])
            carried[key] = determinant.upsilon(factor, S)
            w, v = determinant.generators(S, factor.P)
            if factor.whole:
                w, v = ZERO, ZERO
            elif len(link.dofs) > 1 and not factor.turned:  # turning the link turns H: move P under it instead
                P = articulated.NO_INERTIA if link.inertia is None else link.inertia.articulated
                for child in link.children:
                    P = P + done[id(child)].in_parent
                w, _ = determinant.generators(carried[key], P)
            values = motion.in_hinge(link, place, w, v)
            stores += [Store("out", (dof,), 2.0 * scale * x) for dof, x in zip(link.dofs, values, strict=True)]
        return stores

    def fixman_torque(self) -> list[Store]:
        """out = -1/2 d log det Mass / dq"""
        return self.log_det_mass_matrix_gradient(-0.5)

    def mass_matrix_packed(self) -> list[Store]:
        """out = the entries of Mass that the tree allows, lower triangle, row after row"""
        return _packed(self.mass_matrix())

    def mass_matrix_inverse_packed(self) -> list[Store]:
        """out = the entries of Mass^-1 within one tree, lower triangle, row after row"""
        return _packed(self.mass_matrix_inverse())


def _packed(stores: list[Store]) -> list[Store]:
    entries = {item.index: item.value for item in stores if item.index[0] >= item.index[1]}
    return [Store("out", (i,), entries[index]) for i, index in enumerate(sorted(entries))]
