"""Loops and mimics of a scene with contacts: what the errors say, and a scene without them."""

import numpy as np
import pytest

import warp_spo as spo


def stool() -> spo.Scene:
    """A trunk that slides up and down, on two legs of which one mimics the other."""
    body = spo.Body(1.0, inertia=0.01 * np.eye(3))
    hinges = [
        spo.Hinge("prismatic", -1, 0, axis=(0, 0, 1), label="height"),
        *(spo.Hinge("revolute", 0, leg, axis=(0, 1, 0), label=f"leg {leg}") for leg in (1, 2)),
    ]
    contacts = [spo.Contact(leg, sphere=((0, 0, -0.4), 0.02)) for leg in (1, 2)]
    return spo.Scene([body] * 3, hinges, couplings=[spo.Coupling(2, 1, -1.0)], contacts=contacts)


def test_every_error_names_ways_that_work_with_contacts():
    """The first error, of Dynamics, too: no call sends the reader to another one that refuses."""
    ways = r"loops='cut'.* target_q = ratio q \+ offset.*scene\.with_contacts\(\[\]\), and loops='embed' closes them"
    with pytest.raises(ValueError, match=rf"^Dynamics: the scene has 1 coupling\(s\): leg 2 follows leg 1.*{ways}$"):
        spo.Dynamics(stool(), 1, "cpu")
    for loops in ("embed", "multipliers"):
        with pytest.raises(spo.UnsupportedError, match=rf"step: closing loops in a scene with contacts.*{ways}$"):
            spo.Dynamics(stool(), 1, "cpu", loops=loops).step(np.zeros((1, 3)), np.zeros((1, 3)), None, 1e-3)
    with pytest.raises(ValueError, match="loops='cut' leaves them open, loops='embed' and loops='multipliers' close"):
        spo.Dynamics(stool().with_contacts([]), 1, "cpu")
    assert spo.Dynamics(stool().with_contacts([]), 1, "cpu", loops="embed").closed


def test_a_scene_without_loops_is_the_open_tree():
    """All joints and contacts stay, and nothing is left to close."""
    scene = stool()
    bare = scene.without_loops()
    assert not bare.constraint_summary and scene.constraint_summary and bare.values is scene.values
    assert bare.contact_count == scene.contact_count and bare.joint_labels == scene.joint_labels
    assert not spo.Dynamics(bare, 1, "cpu").closed
    pin = spo.Loop("revolute", -1, 1, axis=(0, 1, 0))
    looped = spo.Scene(scene.bodies, scene.hinges, loops=[pin])
    assert looped.constraint_summary and not looped.without_loops().loops
