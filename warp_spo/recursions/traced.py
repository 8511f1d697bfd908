"""The recursions of a scene as traces: each operation as the values that it stores.

``step`` names say in the emitted code which link and which letter of the paper a value belongs to.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from ..trace.emission import Store
from ..trace.scalars import Value, is_constant, sum_of_logarithms
from ..trace.spatial import IDENTITY, ZERO, Articulated, Matrix, Rigid, Vector, cross, total
from . import articulated, composite, kinematics, messages, motion, newton_euler
from .inverse import Inverse
from .links import Link, Links, Placed, placed
from .motion import STILL, Motion
from .pieces import Piece

EPSILON = {"float32": 2.0**-23, "float64": 2.0**-52}


class Trace:
    """One evaluation of a scene, or of one piece of it: what is shared between the operations on it.

    Args:
        links: the scene's links.
        dtype: whose rounding the pivots are compared with.
        given: names of the arrays that are there: "qd", "tau", "qdd", "body_f", "b"; the others are zero.
        piece: trace the work on this piece alone. How its ancestors move is worked out anew; what it takes from other
            pieces and gives to them goes through the array "sent" or "returned", ``slot(letter, piece)`` on.
        slot: see there.

    Attributes:
        news: what a piece sends to those that meet it, apart: pieces of equal structure do not all send it.
        rounds: what a piece has to store after that, in turns of which many may be alike.
        ahead: what the passes of a loop share, formed once before it.
        checks: what a piece makes of a pass, apart: it keeps nothing for that.
    """

    def __init__(
        self,
        links: Links,
        dtype: str,
        given: tuple[str, ...],
        piece: Piece | None = None,
        slot: Callable[[str, Piece], int] | None = None,
    ):
        self.links, self.graph, self.epsilon, self.given = links, links.graph, EPSILON[dtype], given
        self.piece, self.slot = piece, slot
        self.news: list[Store] = []
        self.rounds: list[list[Store]] = []
        self.ahead: list[Value] = []
        self.checks: list[Store] = []
        self._mail: dict[tuple[str, int], list[Value]] = {}  # messages between pieces of this trace
        self.own = set(map(id, links.links if piece is None else piece.links))
        self.active = set(self.own)
        above = None if piece is None else piece.links[0].parent
        while above is not None:
            self.active.add(id(above))
            above = above.parent
        self.places: dict[int, Placed] = {}
        self.motions: dict[int, Motion] = {}
        self.axes: dict[int, Matrix] = {}  # of every link, in the inertial frame
        self.stiffened: Callable[[Link], Link] = lambda link: link  # with all that its pivots feel beside its inertia
        self.bodies: dict[int, list[int]] = {}  # by link: the bodies that sit on it
        for body, seat in links.seats.items():
            if seat.link is not None:
                self.bodies.setdefault(id(seat.link), []).append(body)

    # -- inputs ----------------------------------------------------------------------------------------------------
    def vector(self, name: str) -> Callable[[int], Value]:
        """``entry(i)`` of an array, or zero if it is not given."""
        if name not in self.given:
            return lambda i: 0.0
        return lambda i: self.graph.input(name, i)

    def at(self, link: Link, letter: str) -> None:
        self.graph.step = f"{link.label}|{letter}"

    def place(self, link: Link, moves: bool = False) -> None:
        self.at(link, "x")
        self.places[id(link)] = place = placed(link, self.vector("q"))
        self.at(link, "w")
        parent = None if link.parent is None else self.motions[id(link.parent)]
        qd = self.vector("qd") if moves else None
        self.motions[id(link)] = motion.moved(link, place, parent, qd) if moves else STILL
        if "body_f" in self.given:
            R = IDENTITY if link.parent is None else self.axes[id(link.parent)]
            self.axes[id(link)] = R @ place.pose.rotation

    def external(self, link: Link) -> Vector:
        """(n; f) of the external wrenches on the bodies of a link, in its frame."""
        n, f = ZERO, ZERO
        if "body_f" not in self.given:
            return Vector((*n, *f))
        axes = self.axes[id(link)]
        for body in self.bodies.get(id(link), ()):
            seat = self.links.seats[body]
            given = Vector(self.graph.input("body_f", body, c) for c in range(6))
            com = seat.offset + seat.matrix @ self.links.nodes[body].com
            n_body, f_body = newton_euler.wrench(axes, com, Vector(given[:3]), Vector(given[3:]))
            n, f = n + n_body, f + f_body
        return Vector((*n, *f))

    # -- pieces ----------------------------------------------------------------------------------------------------
    def traversal(self) -> Iterator[tuple[Link, bool]]:
        """Out to every link that matters here, back from those of this piece."""
        for link, outward in self.links.traversal():
            if id(link) in self.active and (outward or id(link) in self.own):
                yield link, outward

    @property
    def outward(self) -> list[Link]:
        """The links of this piece, parents first."""
        return [link for link in self.links.links if id(link) in self.own]

    def post(self, letter: str, piece: Piece, values: Iterable[Value]) -> list[Store]:
        """Send a message of ``piece``; a trace of the whole tree keeps it."""
        if self.piece is None:
            self._mail[letter, piece.index] = list(values)
            return []
        assert self.slot is not None
        first = self.slot(letter, piece)
        return [Store(messages.way(letter), (first + i,), value) for i, value in enumerate(values)]

    def receive(self, letter: str, piece: Piece) -> list[Value]:
        """The message that ``piece`` sends."""
        if self.piece is None:
            return self._mail[letter, piece.index]
        assert self.slot is not None
        first = self.slot(letter, piece)
        return [self.graph.input(messages.way(letter), first + i) for i in range(messages.size(letter, piece))]

    def carried_on(self, link: Link, letter: str, found: dict[int, Any], build: Callable[[list], Any]) -> list[Any]:
        """What the children of a link hand to it, of this piece or sent by others."""
        if self.piece is None or id(link.children[0] if link.children else link) in self.own:
            return [found[id(child)] for child in link.children]
        return [build(self.receive(letter, piece)) for piece in self.piece.children]

    def handed_on(self, letter: str, link: Link, values: Iterable[Value]) -> list[Store]:
        """Send what a link's parent needs of it, if another piece works on the parent."""
        if self.piece is None or link is not self.piece.links[0] or link.parent is None:
            return []
        return self.post(letter, self.piece, values)

    @property
    def base(self) -> tuple[Vector, Vector]:
        """Acceleration of the inertial frame: gravity's, the other way."""
        return ZERO, -self.links.gravity

    # -- operations ------------------------------------------------------------------------------------------------
    def forward_dynamics(self, right: str = "tau", bias: bool = True) -> list[Store]:
        """out = Mass^-1 (tau - bias_force); without ``bias`` Mass^-1 times the array ``right``."""
        moves = bias and "qd" in self.given
        done, rates, stores = self.reduce(self.vector(right), moves, bias)
        return stores + self.expand(done, rates, self.base if bias else (ZERO, ZERO))

    def forward_dynamics_apart(self) -> list[Store]:
        """The same: velocity terms and loads become forces of the hinges first.

        No link has to keep its velocity while the sweep with P goes in and out: less to hold, at one more pass through
        the tree. Gravity stays the base's acceleration.
        """
        known = self.inverse_dynamics(gravity=False, qdd=lambda dof: 0.0, letter="f")
        forces, tau = {item.index[0]: item.value for item in known if item.array == "out"}, self.vector("tau")
        done, rates, sent = self.reduce(lambda dof: tau(dof) - forces[dof], moves=False, loads=False)
        return [item for item in known if item.array != "out"] + sent + self.expand(done, rates, self.base)

    def forward_dynamics_and_solve(self) -> list[Store]:
        """out = Mass^-1 (tau - bias_force), solved = Mass^-1 cotangent, by one factorisation"""
        stores = self.forward_dynamics()
        done, rates, sent = self.reduce(self.vector("cotangent"), moves=False, loads=False, letters="y")
        return stores + sent + self.expand(done, rates, (ZERO, ZERO), "b", "solved")

    def factor(self) -> dict[int, articulated.Factor]:
        return self.factors()[0]

    def factors(self) -> tuple[dict[int, articulated.Factor], list[Store]]:
        """Factors of every link, and what other pieces need of them."""
        done: dict[int, articulated.Factor] = {}
        inner: dict[int, Articulated] = {}
        stores: list[Store] = []
        for link, outward in self.traversal():
            if outward:
                self.place(link)
                continue
            self.eliminate(link, done, inner)
            stores += self.handed_on("P", link, inner[id(link)].packed)
        return done, stores

    def eliminate(self, link: Link, done: dict[int, articulated.Factor], inner: dict[int, Articulated]) -> None:
        """Add the factor of a link to ``done``, and P+ in its parent's frame to ``inner``, after its children's."""
        self.at(link, "P")
        carried = self.carried_on(link, "P", inner, Articulated.unpacked)
        through = [(self.places[id(child)].pose, done[id(child)].P) for child in link.children if id(child) in done]
        place = self.places[id(link)]
        done[id(link)] = factor = articulated.factor(self.stiffened(link), place, carried, through, self.epsilon)
        inner[id(link)] = factor.in_parent

    def reduce(
        self, tau: Callable[[int], Value], moves: bool, loads: bool, letters: str = "Pz"
    ) -> tuple[dict, dict, list[Store]]:
        """Factors of every link, D^-1 [I - H psi K] (tau - ...), and what other pieces need of them: ``letters``."""
        done: dict[int, articulated.Factor] = {}
        rates: dict[int, list[Value]] = {}
        inner: dict[int, Articulated] = {}
        forces: dict[int, Vector] = {}
        stores: list[Store] = []
        for link, outward in self.traversal():
            key = id(link)
            if outward:
                self.place(link, moves)
                continue
            self.eliminate(link, done, inner)
            place, move, factor = self.places[key], self.motions[key], done[key]
            self.at(link, "z")
            z = articulated.gyroscopic(link.inertia, move)
            if loads:
                z = z - self.external(link)
            for force in self.carried_on(link, letters[-1], forces, Vector):
                z = z + force
            right = [tau(dof) for dof in link.dofs]
            rates[key], forces[key] = articulated.reduced(link, place, factor, move, z, right)
            stores += self.handed_on("P", link, inner[key].packed) if "P" in letters else []
            stores += self.handed_on(letters[-1], link, forces[key])
        return done, rates, stores

    def expand(
        self, done: dict, rates: dict, base: tuple[Vector, Vector], letter: str = "a", name: str = "out"
    ) -> list[Store]:
        alpha: dict[int, tuple[Vector, Vector]] = {}
        stores = []
        for link in self.outward:
            self.at(link, "a")
            key = id(link)
            if link.parent is None:
                above = base
            elif id(link.parent) in self.own:
                above = alpha[id(link.parent)]
            else:
                received = self.receive(letter, self.piece.parent)  # type: ignore[union-attr, arg-type]
                above = Vector(received[:3]), Vector(received[3:])
            qdd, alpha[key] = articulated.expanded(
                link, self.places[key], done[key], rates[key], self.motions[key], above
            )
            stores += [Store(name, (dof,), value) for dof, value in zip(link.dofs, qdd, strict=True)]
            if self.piece is not None and self.piece.children and link is self.piece.links[-1]:
                stores += self.post(letter, self.piece, (*alpha[key][0], *alpha[key][1]))
        return stores

    def inverse_dynamics(
        self, gravity: bool = True, qdd: Callable[[int], Value] | None = None, letter: str = "z"
    ) -> list[Store]:
        """out = Mass qdd + bias_force, for ``qdd`` or the array of that name"""
        base = self.base if gravity else (ZERO, ZERO)
        qdd, moves = qdd or self.vector("qdd"), "qd" in self.given
        alpha: dict[int, tuple[Vector, Vector]] = {}
        forces: dict[int, Vector] = {}
        stores = []
        for link, outward in self.traversal():
            key = id(link)
            if outward:
                self.place(link, moves)
                self.at(link, "a")
                above = base if link.parent is None else alpha[id(link.parent)]
                alpha[key] = newton_euler.accelerated(link, self.places[key], self.motions[key], above, qdd)
                continue
            self.at(link, "f")
            f = -self.external(link)
            if link.grouped is not None:
                f = f + newton_euler.body_force(link.grouped, self.motions[key], *alpha[key])
            for other in self.carried_on(link, letter, forces, Vector):
                f = f + other
            n, f = Vector(f[:3]), Vector(f[3:])
            mass = self.links.thrown(link)
            if mass is None:
                tau = newton_euler.hinge_force(link, self.places[key], n, f, qdd)
            else:
                tau = newton_euler.root_force(link, self.places[key], n, f, mass, alpha[key][1], base, qdd)
            stores += [Store("out", (dof,), value) for dof, value in zip(link.dofs, tau, strict=True)]
            if link.parent is not None:
                n, f = self.places[key].pose.force_to_parent(n, f)
                forces[key] = Vector((*n, *f))
                stores += self.handed_on(letter, link, forces[key])
        return stores

    def mass_matrix(self) -> list[Store]:
        """out = Mass, both triangles"""
        carried: dict[int, Rigid] = {}
        entries: dict[tuple[int, int], Value] = {}
        stores: list[Store] = []
        for link, outward in self.traversal():
            if outward:
                self.place(link)
                continue
            key = id(link)
            self.at(link, "R")
            body = link.grouped or composite.NOTHING
            for other in self.carried_on(link, "R", carried, Rigid.unpacked):
                body = body + other
            if link.parent is not None:
                carried[key] = self.places[key].pose.rigid_to_parent(body)
                stores += self.handed_on("R", link, carried[key].packed)
            self.at(link, "F")
            entries |= composite.entries(link, self.places, body)
        return stores + self._both(entries)

    def _both(self, entries: dict[tuple[int, int], Value]) -> list[Store]:
        placed = (pair for (i, j), entry in entries.items() for pair in _mirrored(i, j, entry))
        return [Store("out", place, value) for place, value in placed]

    def solve_mass_matrix(self) -> list[Store]:
        return self.forward_dynamics("b", bias=False)

    def log_det_mass_matrix(self) -> list[Store]:
        done = self.factor()
        return [Store("out", (), sum_of_logarithms(p.D for f in done.values() for p in f.pivots))]

    def mass_matrix_inverse(self) -> list[Store]:
        """out = Mass^-1, both triangles"""
        inverse = Inverse(self)
        rounds = [self._both(entries) for entries in inverse.rounds]
        if self.piece is not None:
            self.rounds, self.news, rounds = rounds, inverse.news, []
        return inverse.stores + self._both(inverse.entries) + [item for stores in rounds for item in stores]

    def inward(self, done: dict, link: Link, force: Vector, right: list[Value]) -> dict[int, list[Value]]:
        """D^-1 [I - H psi K] of ``right`` at a link's dofs and a ``force`` on it: by link, on the way to the root."""
        rates, over = {}, link
        while True:
            key = id(over)
            rates[key], force = articulated.reduced(over, self.places[key], done[key], STILL, force, right)
            if over.parent is None:
                return rates
            over = over.parent
            right = [0.0] * len(over.dofs)

    def _sandwich(self, D: dict, nothing: Value, halves: dict) -> dict[tuple[int, int], Value]:
        """Y* D Y + nothing; entries of columns that do not meet are absent, unless a pivot may be lost."""
        entries: dict[tuple[int, int], Value] = {}
        names = list(halves)
        for at, i in enumerate(names):
            self.graph.step = f"column {i}|m"
            weighted = {
                key: [rate * d for rate, d in zip(rates, D[key], strict=True)] for key, rates in halves[i].items()
            }
            for j in names[: at + 1]:
                both = [key for key in halves[j] if key in weighted]
                pairs = (pair for key in both for pair in zip(weighted[key], halves[j][key], strict=True))
                entry = total(a * b for a, b in pairs) + nothing
                if both or not is_constant(nothing) or nothing != 0.0:
                    entries[j, i] = entry
        return entries

    # -- kinematics ------------------------------------------------------------------------------------------------
    def place_axes(self, link: Link) -> None:
        """Place a link and find its axes in the inertial frame."""
        self.place(link)
        self.at(link, "R")
        parent = IDENTITY if link.parent is None else self.axes[id(link.parent)]
        self.axes[id(link)] = parent @ self.places[id(link)].pose.rotation

    def frame(self, body: int, origin: tuple) -> tuple[Link | None, Vector]:
        """The link that carries a frame of a body, and the frame's origin in the link's frame."""
        seat = self.links.seats[body]
        R, p = self.links.nodes[body].anchor
        return seat.link, seat.offset + seat.matrix @ (R.T @ (Vector(origin) - p))

    def jacobian(self, frames: tuple) -> list[Store]:
        """out [frame, 6, dof]: velocity of each frame's origin, then angular velocity, inertial axes, per unit qd."""
        for each in self.links.links:
            self.place_axes(each)
        stores = []
        for index, (body, origin) in enumerate(frames):
            link, arm = self.frame(body, origin)
            while link is not None:
                self.at(link, f"j{index}_")
                parent = IDENTITY if link.parent is None else self.axes[id(link.parent)]
                for dof, (w, v) in zip(
                    link.dofs, kinematics.columns(link, parent, self.axes[id(link)], arm), strict=True
                ):
                    stores += [Store("out", (index, c, dof), value) for c, value in enumerate((*v, *w))]
                pose = self.places[id(link)].pose
                arm, link = pose.point_to_parent(arm), link.parent
        return stores

    def operational_inertia_inverse(self, frames: tuple) -> list[Store]:
        """out [6 frames, 6 frames] = J Mass^-1 J*: a unit wrench on a frame, sent inward, is a column of Y."""
        for each in self.links.links:
            self.place_axes(each)
        done = self.factor()
        halves: dict[int, dict] = {}
        for row, (link, wrench) in enumerate(self.unit_wrenches(frames)):
            halves[row] = {} if link is None else self.inward(done, link, wrench, [0.0] * len(link.dofs))
        return self._both(self._sandwich(*pivots(done), halves))

    def unit_wrenches(self, frames: tuple) -> Iterator[tuple[Link | None, Vector]]:
        """The link of each frame, and (n; f) in its frame of three unit forces, then torques."""
        for index, (body, origin) in enumerate(frames):
            link, arm = self.frame(body, origin)
            for c in range(6):
                if link is None:
                    yield None, ZERO
                    continue
                self.at(link, f"y{index}{c}_")
                axis = self.axes[id(link)][c % 3]
                yield link, Vector((*cross(arm, axis), *axis) if c < 3 else (*axis, *ZERO))

    def body_poses(self) -> list[Store]:
        """out [body, 7] = position, quaternion xyzw"""
        q = self.vector("q")
        at: dict[int | None, Vector] = {None: ZERO}
        turns: dict[int | None, Vector] = {None: Vector((0.0, 0.0, 0.0, 1.0))}
        for link in self.links.links:
            self.at(link, "p")
            over = None if link.parent is None else id(link.parent)
            self.places[id(link)] = place = placed(link, q)
            at[id(link)] = at[over] + kinematics.turned(turns[over], place.pose.l)
            turns[id(link)] = kinematics.multiplied(turns[over], kinematics.relative_quaternion(link, q))
        stores = []
        for body, seat in self.links.seats.items():
            R, p = self.links.nodes[body].anchor
            key = None if seat.link is None else id(seat.link)
            axes = seat.matrix @ R.T
            position = at[key] + kinematics.turned(turns[key], seat.offset - axes @ p)
            pose = (*position, *kinematics.multiplied(turns[key], kinematics.constant_quaternion(axes)))
            stores += [Store("out", (body, c), value) for c, value in enumerate(pose)]
        return stores

    def body_velocities(self) -> list[Store]:
        """out [body, 6] = velocity of the CoM, angular velocity, in inertial axes"""
        velocity: dict[int | None, tuple[Vector, Vector]] = {None: (ZERO, ZERO)}
        for link in self.links.links:
            self.place_axes(link)
            self.at(link, "v")
            place, over = self.places[id(link)], None if link.parent is None else id(link.parent)
            hinge = motion.in_link(link, place, self.vector("qd"))
            velocity[id(link)] = kinematics.carried_velocity(place, velocity[over], hinge)
        stores = []
        for body, seat in self.links.seats.items():
            key = None if seat.link is None else id(seat.link)
            w, v = velocity[key]
            R = IDENTITY if key is None else self.axes[key]
            com = seat.offset + seat.matrix @ self.links.nodes[body].com
            values = (*kinematics.velocity(R, w, v, com), *(R @ w))
            stores += [Store("out", (body, c), value) for c, value in enumerate(values)]
        return stores

    def body_states(self) -> list[Store]:
        """out = body_poses, velocities_out = body_velocities"""
        return self.body_poses() + [item._replace(array="velocities_out") for item in self.body_velocities()]


def pivots(done: dict[int, articulated.Factor]) -> tuple[dict[int, list[Value]], Value]:
    """D by link, and NaN where a pivot is lost that nobody would notice."""
    return {key: [pivot.D for pivot in factor.pivots] for key, factor in done.items()}, total(
        factor.nothing for factor in done.values()
    )


def _mirrored(i: int, j: int, value: Value) -> list[tuple[tuple[int, int], Value]]:
    return [((i, j), value)] if i == j else [((i, j), value), ((j, i), value)]
