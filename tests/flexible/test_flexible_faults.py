"""Errors of flexible bodies: wrong arrays, names of several places, worlds that differ, matrices that do not fit."""

import numpy as np
import pytest

import warp_spo as spo

NAN = np.full((6, 1), np.nan)
PLACE = (1.0, 0, 0, 0, 0, 0, 1)


def modes(**values):
    """One mode, of its points if there are some."""
    own = {} if "points" in values else {"mass": [[0.1]], "coupling": np.zeros((6, 1))}
    return spo.Modes(**{"stiffness": [1.0], **own, **values})


def points(mass=(1.0,), shapes=(((1.0,), (0,), (0,)),)):
    return spo.MassPoints(mass, [(0, 0, 0)], shapes)


def scene(slopes=None, mass=2.0, sites=None, **values):
    """A flexible body that carries another one."""
    own = modes(slopes=slopes, **values)
    bodies = [spo.Body(mass, inertia=np.eye(3), modes=own, label="arm"), spo.Body(1.0, inertia=np.eye(3), label="tip")]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=(0, 0, 1), parent_pose=PLACE) for k in range(2)]
    return spo.Scene(bodies, hinges, sites=sites or {})


ONE, TWO = np.zeros((6, 1)), np.ones((6, 1))
RAGGED = [[1.0], [1.0, 2.0]]


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: modes(mass=5.0), "mass is 5.0; expected numbers of shape (n, n)"),
        (lambda: modes(mass=RAGGED), "expected numbers of shape (n, n)"),
        (lambda: modes(stiffness=3.0), "stiffness has shape (); expected (1,)"),
        (lambda: modes(stiffness=RAGGED), "expected numbers of shape (1,)"),
        (lambda: modes(slopes=ONE), "expected arrays (6, 1) by label of a child"),
        (lambda: modes(stiffening=ONE), "expected arrays (3, 1, 1) by label of a child"),
        (lambda: modes(points=3), "points is 3; expected spo.MassPoints"),
        (lambda: modes(shape=3), "shape is 3; expected a function of a position"),
        (lambda: points(mass=["a"]), "expected numbers of shape (1,)"),
        (lambda: points(mass=[1j]), "expected numbers of shape (1,)"),
        (lambda: points(mass=RAGGED), "mass has shape ()"),
        (lambda: points(shapes=[[[1], [1, 2], [1]]]), "shapes ()"),
        (lambda: points(mass=np.ma.array([1.0], mask=[True])), "masked array"),
        (lambda: scene(shape=lambda place: None), "shape returns None for body 'tip'; expected slopes (6, 1)"),
        (lambda: scene(shape=lambda place: (np.zeros((6, 2)), None)), "has shape (6, 2); expected (6, 1)"),
        (lambda: scene(shape=lambda place: (NAN, None)), "expected finite numbers"),
        (lambda: scene({"tip": ONE, 1: TWO}), "slopes for 'tip' and for its index 1; expected one of them"),
        (lambda: scene({"tip": ONE}, stiffening={1: np.ones((3, 1, 1))}), "stiffening names 1, which slopes does not"),
        (lambda: scene({"tip": TWO}, sites={"tip": (0, PLACE)}), "'tip', a name of several places"),
        (lambda: scene({"tip": ONE, "s": TWO}, sites={"s": (0, (0, *PLACE[1:]))}), "'s' at its origin"),
        (
            lambda: scene({"tip": ONE, "s": TWO, "t": ONE}, sites={"s": (0, PLACE), "t": (0, PLACE)}),
            "'s' and 't', which sit at the same place",
        ),
        (lambda: scene({"tip": ONE}, mass=0.0, coupling=TWO), "expected none below zero"),
        (
            lambda: spo.beam_modes(
                1.0, spo.Section.tube(radius=0.1, wall=0.01), spo.Material(7800.0, 2e11), children=[1.0]
            ),
            "children is [1.0]; expected places by label",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(make, expected):
    with pytest.raises((TypeError, ValueError), match=r"^(Modes|MassPoints|Scene|beam_modes): ") as error:
        make()
    assert expected in str(error.value)


def test_a_flexible_body_without_mass_is_a_spring():
    """The inertia turns, no mass moves: no division by the mass."""
    assert scene({"tip": ONE}, mass=0.0).dof_count == 3


def test_values_of_a_flexible_body_are_checked_and_equal_in_all_worlds():
    """Its mean motion follows from them, one for all worlds: where they differed, so did the coupling of the others."""
    made = scene({"tip": ONE}, points=points())
    with pytest.raises(spo.UnsupportedError, match=r"with_values: body_mass of body 'arm'.*differs between worlds"):
        made.with_values(body_mass=[[2.0, 1.0], [3.0, 1.0]])
    with pytest.raises(ValueError, match="mass matrix of body and modes has the eigenvalue"):
        made.with_values(body_mass=[0.5, 1.0])
    assert made.with_values(body_mass=[[2.0, 1.0], [2.0, 3.0]]).worlds == 2  # a load may differ
