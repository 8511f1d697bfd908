"""Steps of bodies that touch each other: the comparison with the dense step, other forms of a kernel, planted bugs."""

import inspect
import textwrap

import numpy as np

from warp_spo.reference.body_contact import PairStep

from .pair_scenes import H, stepped


def points_of(solver, world):
    """Return the points that the solver in joint space has found in a world, by number of the pair."""
    near = solver.near.numpy().reshape(solver.worlds, -1)[world]
    most, found = solver.near_count, {}
    touches = solver.touches.numpy().reshape(solver.worlds, most, 8, 7)[world]
    for k in range(min(near[0], most)):
        if near[1 + k] >= 0:
            rows = touches[k, : near[1 + most + k]].astype(np.float64)
            found[solver.tables.pairs[near[1 + k]]] = [(row[:3], row[3:6], row[6]) for row in rows]
    return found


class StepAtPoints(PairStep):
    """A dense step whose pairs share points that were found elsewhere, by number of the pair."""

    def __init__(self, found, *args, **options):
        self.found = found
        super().__init__(*args, **options)

    def points_of(self, number, first, second):
        return self.found.get(number, [])


TOLERANCE = {"float64": (1e-10, 1e-9), "float32": (1e-4, 1e-3)}
"""Of velocities, over the largest one, and of forces, over the largest one; 4e-13 and 3e-12, 2e-5 and 2e-4 measured."""


def assert_is_dense(dyn, q, qd, passes=None, least=1, **values):
    """A step is the dense one in every world, with ``values`` of the scene; return what it finds."""
    scene = dyn.scene.with_values(**values)
    found, (velocity, force) = stepped(dyn, q, qd, passes=passes), TOLERANCE[dyn.dtype.__name__]
    touching, points = 0, len(dyn.scene.contact_points)
    for w in range(len(q)):
        at = PairStep(scene, q[w], qd[w], H, world=w)
        after, wanted = at.run(passes=passes or 4)
        f, gap, slip = at.reports(wanted)
        most = max(1.0, np.abs(wanted.f).max())
        touching += (np.abs(f).max(axis=1) > 0.0).sum()
        np.testing.assert_allclose(found["qd"][w], wanted.v, atol=velocity * np.abs(wanted.v).max())
        np.testing.assert_allclose(found["q"][w], after, atol=velocity)
        np.testing.assert_allclose(found["contact_f"][w, points:], f, atol=force * most)
        np.testing.assert_allclose(found["contact_gap"][w, points:], gap, atol=1e-6)
        np.testing.assert_allclose(found["contact_slip"][w, points:], slip, atol=velocity * np.abs(wanted.v).max())
        np.testing.assert_allclose(found["contact_excess"][w], wanted.excess, atol=force * most)
    assert touching >= least
    return found


def plant(monkeypatch, place, old, new, text="NATIVE"):
    """Put a bug into native code, the ``text`` of a module, or into the text of a method."""
    if inspect.ismodule(place):
        native = getattr(place, text)
        assert native.count(old) == 1
        monkeypatch.setattr(place, text, native.replace(old, new))
        return
    source, names = textwrap.dedent(inspect.getsource(place)), dict(place.__globals__)
    assert source.count(old) == 1
    exec(source.replace(old, new), names)
    owner = getattr(inspect.getmodule(place), place.__qualname__.split(".")[0])
    monkeypatch.setattr(owner, place.__name__, names[place.__name__])
