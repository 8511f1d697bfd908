"""Links with variable values: computed once a setting, and an operation reads no more of them than it needs."""

import numpy as np
import pytest

import warp_spo as spo
from support import laws, zoo
from support.routines import ROUTINES
from warp_spo.kernels import fields
from warp_spo.recursions.model.links import TABLES, Links
from warp_spo.reference import dense as reference
from warp_spo.trace.scalars import ordered

INERTIAS = ("body_mass", "body_com", "body_inertia")
WORLDS = 3


def gripper():
    """A fixed base, two hinges, and a hand of three bodies that are fixed to the last link and to one another."""
    return zoo.from_parents([-1, 0, 1, 2, 3, 2], ["fixed", "revolute", "revolute", "fixed", "fixed", "fixed"], 9)


def find(dyn, operation="forward_dynamics", names=("qd", "tau")):
    rate = (dyn.worlds, dyn.scene.dof_count)
    shapes = {"q": (dyn.worlds, dyn.scene.coord_count)} | dict.fromkeys(names, rate)
    return dyn.programs.find(ROUTINES[operation], shapes, rate)


def entries_read(monkeypatch, scene, operation="forward_dynamics", **options):
    """How many entries of which tables one evaluation loads."""
    dyn = spo.Dynamics(scene, device="cpu", granularity="tree", **options)
    stores = []
    layout = dyn.programs.builder.layout
    monkeypatch.setattr(dyn.programs.builder, "layout", lambda *given: stores.extend(given[1]) or layout(*given))
    find(dyn, operation)
    symbols = (item.value for item in stores if not isinstance(item.value, float))
    return [s.args for s in ordered(symbols) if s.op == "input" and s.args[0] in dyn.programs.links.tables]


def test_ten_numbers_a_link_and_no_more(monkeypatch):
    """Fixed bodies are merged before: six bodies, two links."""
    read = entries_read(monkeypatch, gripper(), variable=INERTIAS)
    assert {table for table, _ in read} == {"value"}
    assert len(read) == len(set(read)) <= 10 * 2
    assert len(entries_read(monkeypatch, gripper(), variable=("gravity",))) == 3
    assert len(entries_read(monkeypatch, gripper(), variable=("joint_armature",))) == 2


def test_what_is_the_same_in_all_worlds_folds(monkeypatch):
    """A load that differs on the hand leaves the other link alone."""
    scene = gripper()
    mass = np.repeat(scene.values["body_mass"], WORLDS, axis=0)
    mass[:, 5] *= [1.0, 1.5, 2.0]
    loaded = scene.with_values(body_mass=mass)
    assert 0 < len(entries_read(monkeypatch, loaded)) <= 10
    assert len(entries_read(monkeypatch, scene.with_values(body_mass=mass[:1].repeat(WORLDS, axis=0)))) == 0
    assert not Links(scene).tables["value"] and Links(scene).graph.empty


@pytest.mark.parametrize("granularity", ["tree", "node"])
@pytest.mark.parametrize("variable", [INERTIAS, ("joint_X_p", "joint_X_c"), ("body_mass",)])
def test_bodies_that_are_fixed_to_a_link(granularity, variable, device):
    scene = gripper()
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity=granularity, variable=variable)
    arrays = laws.states(scene, WORLDS)
    for seed in (0, 1):
        now = scene.with_values(**{name: zoo.varied(scene, WORLDS, seed).values[name] for name in variable})
        dyn.set(**{name: now.values[name] for name in variable})
        got = laws.numpy_call(dyn, "forward_dynamics", arrays)
        operators = dyn.operators(arrays["q"])
        whole = (operators.H @ operators.phi @ operators.M @ operators.phi.T @ operators.H.T + operators.Delta).dense()
        for world in range(WORLDS):
            dense = reference.Dense(now, arrays["q"][world], world=world)
            state = {name: array[world] for name, array in arrays.items()}
            wanted = laws.OPERATIONS["forward_dynamics"][1](dense, state)
            assert laws.error(got[world], wanted) <= laws.TOLERANCE["float64"]
            assert laws.error(whole[world], dense.mass_matrix) <= laws.TOLERANCE["float64"]


def test_values_are_rounded_once(device):
    """Tables in float32 are those in float64, rounded."""
    scene, tables = zoo.varied(gripper(), WORLDS), []
    for dtype in ("float64", "float32"):
        dyn = spo.Dynamics(scene, device=device, dtype=dtype, granularity="tree")
        find(dyn)
        tables.append([laws.entries(dyn.programs.field(name)) for name in ("value", "node_value")])
    for wide, narrow in zip(*tables, strict=True):
        np.testing.assert_array_equal(narrow, wide.astype(np.float32))


def test_all_tables_of_links_lie_in_tiles():
    assert fields.TILED == TABLES


def test_what_no_graph_knew_of_is_derived_at_each_request(device):
    """Values that a captured graph sets reach what was first asked for after the capture."""
    scene = gripper()
    for granularity in ("tree", "node"):
        dyn = spo.Dynamics(scene, 1, device=device, dtype="float64", granularity=granularity, variable=INERTIAS)
        arrays, parameters = laws.states(scene, 1), dyn.recursions.parameters
        parameters._captured = True
        before = laws.numpy_call(dyn, "forward_dynamics", arrays)
        mass = 2.0 * scene.values["body_mass"]
        fresh = spo.Dynamics(scene.with_values(body_mass=mass), 1, device=device, dtype="float64", granularity="node")
        source = fresh.recursions.parameters._values["body_mass"]
        parameters._values["body_mass"].assign(source)  # as a replayed graph does it
        after = laws.numpy_call(dyn, "forward_dynamics", arrays)
        wanted = laws.numpy_call(fresh, "forward_dynamics", arrays)
        assert laws.error(after, wanted) <= laws.TOLERANCE["float64"] < laws.error(before, wanted)


def test_a_turning_link_keeps_seven_numbers():
    """A mass on the axis of a hinge counts as its parent's, and on the base it costs nothing."""
    for link in Links(zoo.chain(5)).links:
        mass, h_x, h_y, h_z, _, J_yy, *_ = link.grouped.packed
        assert mass == h_z == J_yy == 0.0 and h_x != 0.0 != h_y
        assert link.inertia.mass > 0.0
