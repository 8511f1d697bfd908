"""The spatial operators and their compositions, applied to traced vectors.

A vector over nodes gives a node's (omega; v) or (n; f) in its node frame, a vector over hinges the entries of a node's
hinge. Entries are computed node by node at their first use, so that the factors of a product are evaluated together, as
in a recursion, and few values live at once. ``expressions.py`` says what an expression is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from ..trace.emission import Store
from ..trace.scalars import Value
from ..trace.spatial import IDENTITY, ZERO, Articulated, Pose, Vector, cross, dot
from . import articulated
from .expressions import NODES, Expression, spaces
from .model.links import Link, LinkPlacement, place_link
from .motion import hinge_entries, hinge_motion

if TYPE_CHECKING:
    from .model.tracing import Trace

Field = Callable[[int], Any]  # node -> Vector of its entries


class Operators:
    """The operators of the scene of a trace."""

    def __init__(self, trace: Trace):
        self.trace, self.links, self.graph = trace, trace.links, trace.graph
        self.scene = trace.links.scene
        self.parent = self.scene.tree.parent
        self.q = trace.vector("q")
        self.chains: dict[int, list[Link]] = {k: [] for k in range(self.scene.body_count)}
        for link in self.links.links:
            self.chains[link.node].append(link)
        self._hops: dict[int, list[tuple[Link | None, Pose]]] = {}
        self._places: dict[int, LinkPlacement] = {}
        self._factors: dict[int, articulated.LinkFactor] = {}
        self._inertias: dict[int, Articulated] = {}

    def stores(self, expression: Expression) -> list[Store]:
        """out = expression x"""
        rows, columns = spaces(expression)
        result = self.apply(expression, self.input_vector(columns or rows or NODES))
        found = []
        for node in self._inward_order():
            values = result(node)
            first = self._first(rows or columns or NODES, node)
            found += [Store("out", (first + i,), value) for i, value in enumerate(values)]
        return found

    def input_vector(self, space: str) -> Field:
        """Return the input array x as a vector over a space."""

        def at(node: int) -> Vector:
            first = self._first(space, node)
            self._label(node, "x")
            return Vector(self.graph.input("x", first + i) for i in range(self._size(space, node)))

        return at

    def _first(self, space: str, node: int) -> int:
        return 6 * node if space == NODES else int(self.scene.qd_start[self.scene.hinge_of[node]])

    def _size(self, space: str, node: int) -> int:
        return 6 if space == NODES else self.scene.hinge_sizes[node]

    def _label(self, node: int, letter: str) -> None:
        self.graph.step = f"body {node}|{letter}"

    def _inward_order(self) -> Iterator[int]:
        """Yield every node after all that it carries, limb by limb."""
        stack = [(node, False) for node in reversed(self.scene.tree.roots)]
        while stack:
            node, carried = stack.pop()
            if carried:
                yield node
                continue
            stack.append((node, True))
            stack += [(child, False) for child in reversed(self.scene.tree.children[node])]

    # -- composing -------------------------------------------------------------------------------------------------
    def apply(self, expression: Expression, x: Field, transposed: bool = False) -> Field:
        """Return ``expression x``, or the transpose times x."""
        if isinstance(expression, str):
            return self._letter(expression, x, transposed)
        form, *operands = expression
        if form == "identity":
            return x
        if form == "transpose":
            return self.apply(operands[0], x, not transposed)
        if form == "scaled":
            factor, y = operands[0], self.apply(operands[1], x, transposed)
            return _once(lambda node: y(node) * factor)
        if form == "resolvent":
            weight = self._weight(operands[0] == "E_psi", transposed)
            return self._outward(x, weight) if transposed else self._inward(x, weight)
        if form == "product":
            for factor in operands if transposed else reversed(operands):
                x = self.apply(factor, x, transposed)
            return x
        terms = [self.apply(term, x, transposed) for term in operands]

        def add_terms(node: int) -> Vector:
            result = terms[0](node)
            for term in terms[1:]:
                result = result + term(node)
            return result

        return _once(add_terms)

    def _letter(self, letter: str, x: Field, transposed: bool) -> Field:
        if letter in ("E_phi", "E_psi"):
            weight = self._weight(letter == "E_psi", transposed)
            if transposed:
                return _once(lambda node: self._from_parent(node, x, weight))
            return _once(lambda node: self._from_children(node, x, weight))
        if letter == "D":
            lever = self.apply("H", self.apply("P", self.apply("H", x, True)))
            offset = self.apply("Delta", x)
            return _once(lambda node: lever(node) + offset(node))
        steps: dict[str, Callable[[int, Vector], Vector]] = {
            "H": self._spread if transposed else self._collect,
            "M": self._momentum,
            "P": self._apply_inertia,
            "Delta": self._armature,
            "D_inverse": self._solve,
            "G": self._gain_transposed if transposed else self._gain,
        }
        return _once(lambda node: steps[letter](node, x(node)))

    # -- sweeps ----------------------------------------------------------------------------------------------------
    def _inward(self, x: Field, weight: Callable[[int, Vector], Vector]) -> Field:
        """y(k) = x(k) + sum of w(k, j) y(j) over the children j"""
        known: dict[int, Vector] = {}
        sums: dict[int, Vector] = {}
        waiting: set[int] = set()

        def at(top: int) -> Vector:
            stack = [top]
            while stack:  # a loop, because a chain may be longer than Python's stack
                node = stack[-1]
                if node in known:
                    stack.pop()
                elif node in waiting:
                    stack.pop()
                    value = x(node)
                    self._label(node, "y")
                    known[node] = value + sums[node] if node in sums else value
                    self._hand_on(node, known[node], weight, sums)
                else:
                    waiting.add(node)
                    stack += [child for child in reversed(self.scene.tree.children[node]) if child not in known]
            return known[top]

        return at

    def _hand_on(self, node: int, y: Vector, weight: Callable[[int, Vector], Vector], sums: dict) -> None:
        parent = self.parent[node]
        if parent >= 0:
            handed = weight(node, y)
            sums[parent] = sums[parent] + handed if parent in sums else handed

    def _outward(self, x: Field, weight: Callable[[int, Vector], Vector]) -> Field:
        """y(k) = x(k) + w*(p, k) y(p)"""
        known: dict[int, Vector] = {}

        def at(node: int) -> Vector:
            path = []
            while node >= 0 and node not in known:
                path.append(node)
                node = self.parent[node]
            for below in reversed(path):
                value = x(below)
                self._label(below, "v")
                if self.parent[below] >= 0:
                    value = value + weight(below, known[self.parent[below]])
                known[below] = value
            return known[path[0] if path else node]

        return at

    def _from_children(self, node: int, x: Field, weight: Callable[[int, Vector], Vector]) -> Vector:
        result = None
        for child in self.scene.tree.children[node]:
            handed = weight(child, x(child))
            result = handed if result is None else result + handed
        return Vector([0.0] * 6) if result is None else result

    def _from_parent(self, node: int, x: Field, weight: Callable[[int, Vector], Vector]) -> Vector:
        parent = self.parent[node]
        return Vector([0.0] * 6) if parent < 0 else weight(node, x(parent))

    def _weight(self, articulated_too: bool, transposed: bool) -> Callable[[int, Vector], Vector]:
        """w(p, k) of phi or of psi, that is phi(p, k) (1 - G H), applied to a force; or its transpose, to a motion."""
        if transposed:
            return lambda node, v: self._motion(node, v, articulated_too)
        return lambda node, z: self._force(node, z, articulated_too)

    def _force(self, node: int, z: Vector, less: bool) -> Vector:
        for link, pose in reversed(self.hops(node)):
            if link is not None and less:
                _, z = self._eliminate(link, z, [0.0] * len(link.dofs))
            self._label(node, "z")
            z = _join(pose.force_to_parent(*_parts(z)))
        return z

    def _motion(self, node: int, v: Vector, less: bool) -> Vector:
        for link, pose in self.hops(node):
            self._label(node, "v")
            v = _join(pose.motion_to_child(*_parts(v)))
            if link is not None and less:
                _, v = self._release(link, v)
        return v

    # -- hinges ----------------------------------------------------------------------------------------------------
    def _collect(self, node: int, z: Vector) -> Vector:
        """H z"""
        self._label(node, "h")
        tau: list[Value] = []
        for link, pose, first in self._inner(node):
            if link is not None:
                tau = [*hinge_entries(link, self.place(link), *_parts(z)), *tau]
            if not first:
                z = _join(pose.force_to_parent(*_parts(z)))
        return Vector(tau)

    def _spread(self, node: int, rates: Vector) -> Vector:
        """H* rates"""
        self._label(node, "h")
        v, at = Vector((*ZERO, *ZERO)), 0
        for link, pose, first in reversed(self._inner(node)):
            if not first:
                v = _join(pose.motion_to_child(*_parts(v)))
            if link is not None:
                own = list(rates[at : at + len(link.dofs)])
                at += len(own)
                entries = dict(zip(link.dofs, own, strict=True))
                v = v + _join(hinge_motion(link, self.place(link), lambda dof, entries=entries: entries[dof]))
        return v

    def _armature(self, node: int, x: Vector) -> Vector:
        self._label(node, "d")
        own = [a for link in self.chains[node] for a in link.armature]
        return Vector(a * value for a, value in zip(own, x, strict=True))

    def _gain(self, node: int, right: Vector) -> Vector:
        """Return G right: the force on the parent for hinge forces ``right`` and no force on the body."""
        z, at = Vector((*ZERO, *ZERO)), len(right)
        inner = self._inner(node)
        for link, pose, first in inner:
            if link is not None:
                at -= len(link.dofs)
                _, z = self._eliminate(link, z, list(right[at : at + len(link.dofs)]))
            if not first:
                z = _join(pose.force_to_parent(*_parts(z)))
        self._label(node, "g")
        for _, pose, first in reversed(inner):
            if not first:
                n, f = _parts(z)
                z = _join((pose.to_child(n - cross(pose.l, f)), pose.to_child(f)))
        return z

    def _gain_transposed(self, node: int, v: Vector) -> Vector:
        """Return G* v, by dof of the node's hinge, for a motion v = (omega; v) in the node's frame; G = P H* D^-1.

        A node's hinge may be several links in series. The motion is first carried inward to the frame of the first of
        them, as if the hinge stood still. From there outward each link gives the rates of its own dofs, and hands on
        the motion less that of these rates, see :meth:`_release`.
        """
        self._label(node, "g")
        inner, rates = self._inner(node), []
        for _, pose, first in inner:
            if not first:
                w, v = _parts(v)
                w, v = pose.to_parent(w), pose.to_parent(v)
                v = Vector((*w, *(v - cross(w, pose.l))))
        for link, pose, first in reversed(inner):
            if not first:
                v = _join(pose.motion_to_child(*_parts(v)))
            if link is not None:
                own, v = self._release(link, v)
                rates += own
        return Vector(rates)

    def _solve(self, node: int, right: Vector) -> Vector:
        """D^-1 right"""
        z, at, reduced = Vector((*ZERO, *ZERO)), len(right), {}
        inner = self._inner(node)
        for link, pose, first in inner:
            if link is not None:
                at -= len(link.dofs)
                reduced[id(link)], z = self._eliminate(link, z, list(right[at : at + len(link.dofs)]))
            if not first:
                z = _join(pose.force_to_parent(*_parts(z)))
        v, found = Vector((*ZERO, *ZERO)), []
        for link, pose, first in reversed(inner):
            if not first:
                v = _join(pose.motion_to_child(*_parts(v)))
            if link is not None:
                own, v = self._release(link, v, reduced[id(link)])
                found += [-rate for rate in own]
        return Vector(found)

    def _eliminate(self, link: Link, z: Vector, right: list[Value]) -> tuple[list[Value], Vector]:
        """D^-1 (right - H z), pivot by pivot, and z + G (right - H z), of one link, in its frame."""
        done, place, rates = self.factor(link), self.place(link), []
        self._label(link.node, "z")
        if done.turned:
            triples = [link.hinge.in_link_axes(place, right[i : i + 3]) for i in range(0, len(right), 3)]
            right = [x for triple in triples for x in triple]
        for pivot, b in zip(done.pivots, right[::-1], strict=True):
            rate, z = articulated.reduce_pivot(pivot, z, b)
            rates.append(rate)
        return rates, z

    def _release(self, link: Link, v: Vector, given: list[Value] | None = None) -> tuple[list[Value], Vector]:
        """Return rates = G* v - ``given`` by dof, and v - H* rates: the adjoint of :meth:`_eliminate`."""
        done, place, rates = self.factor(link), self.place(link), []
        self._label(link.node, "v")
        given = [0.0] * len(done.pivots) if given is None else given
        for pivot, own in zip(done.pivots[::-1], given[::-1], strict=True):
            rates.append(pivot.inverse * dot(pivot.U, v) - own)
            v = v - pivot.column * rates[-1]
        if done.turned:
            rates = hinge_entries(link, place, Vector(rates[-3:]), Vector(rates[:3]))
        return rates, v

    # -- bodies ----------------------------------------------------------------------------------------------------
    def _momentum(self, node: int, v: Vector) -> Vector:
        self._label(node, "m")
        return _join(self.links.nodes[node].rigid.apply(*_parts(v)))

    def _apply_inertia(self, node: int, v: Vector) -> Vector:
        P = self.inertia(node)
        self._label(node, "p")
        return _join(P.apply(*_parts(v)))

    def inertia(self, top: int) -> Articulated:
        """P(k) in the node frame."""
        below, stack = [], [top]
        while stack:
            below.append(stack.pop())
            stack += [child for child in self.scene.tree.children[below[-1]] if child not in self._inertias]
        for node in reversed(below):
            P = self.links.nodes[node].rigid.articulated
            for child in self.scene.tree.children[node]:
                link, pose = self.hops(child)[0]
                done = None if link is None else self.factor(link)
                self._label(node, "P")
                if done is None or not done.whole:  # a free hinge hands nothing on
                    P = P + pose.articulated_to_parent(self._inertias[child] if done is None else done.P)
            self._inertias[node] = P
        return self._inertias[top]

    # -- what is shared --------------------------------------------------------------------------------------------
    def place(self, link: Link) -> LinkPlacement:
        """Return the placement of a link."""
        if id(link) not in self._places:
            self.graph.step = f"{link.title}|x"
            self._places[id(link)] = place_link(link, self.q)
        return self._places[id(link)]

    def hops(self, node: int) -> list[tuple[Link | None, Pose]]:
        """Return the poses from the parent's node frame to the node's: along the hinge's links, then to the body's
        placement."""
        if node not in self._hops:
            chain, placement = self.chains[node], self.links.placements[node]
            found: list[tuple[Link | None, Pose]] = []
            if chain:
                self.graph.step = f"{chain[0].title}|x"
                found.append((chain[0], place_link(self.links.on_parent_node(chain[0]), self.q).pose))
                found += [(link, self.place(link).pose) for link in chain[1:]]
                if placement.matrix != IDENTITY or not placement.offset.vanishes:
                    found.append(
                        (None, Pose(None, None if placement.matrix == IDENTITY else placement.matrix, placement.offset))
                    )
            else:
                matrix, offset = self.links.nodes[node].tree
                found.append((None, Pose(None, None if matrix == IDENTITY else matrix, offset)))
            self._hops[node] = found
        return self._hops[node]

    def _inner(self, node: int) -> list[tuple[Link | None, Pose, bool]]:
        """Return the hops from the node inward, and whether each is that of the hinge's first link, to the parent.

        The list is empty where the hinge is fixed.
        """
        if not self.chains[node]:
            return []
        return [(link, pose, link is self.chains[node][0]) for link, pose in reversed(self.hops(node))]

    def factor(self, top: Link) -> articulated.LinkFactor:
        """Return the factor of a link; see :func:`warp_spo.recursions.articulated.factor`."""
        below, stack = [], [top]
        while stack:
            below.append(stack.pop())
            stack += [child for child in below[-1].children if id(child) not in self._factors]
        for link in reversed(below):
            if id(link) in self._factors:
                continue
            place, children = self.place(link), [self._factors[id(child)] for child in link.children]
            poses = [self.place(child).pose for child in link.children]
            self.graph.step = f"{link.title}|P"
            self._factors[id(link)] = articulated.factor(
                link,
                place,
                [child.in_parent for child in children],
                [(pose, child.P) for pose, child in zip(poses, children, strict=True)],
                self.trace.epsilon,
            )
        return self._factors[id(top)]


def _once(value: Field) -> Field:
    """Return ``value`` with its results kept by node."""
    known: dict[int, Vector] = {}

    def at(node: int) -> Vector:
        if node not in known:
            known[node] = value(node)
        return known[node]

    return at


def _parts(v: Vector) -> tuple[Vector, Vector]:
    return Vector(v[:3]), Vector(v[3:])


def _join(parts: tuple[Vector, Vector]) -> Vector:
    return Vector((*parts[0], *parts[1]))


def expression(trace: Trace, expression: Expression) -> list[Store]:
    """out = an operator, or what is composed of several, times the array x."""
    return Operators(trace).stores(expression)
