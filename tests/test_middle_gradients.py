"""The way back through velocity terms in the middle of a step: against the reverse of the whole graph; by limbs."""

import geared
import numpy as np
import pytest
import symbolic
import warp_machine
import zoo
from contact_cases import quadruped, waisted
from step_scenes import furnished, states

import warp_spo as spo
from warp_spo.dynamics.rounds import BIAS_VJP
from warp_spo.recursions.contact.middle import FOUND, middle_bias
from warp_spo.recursions.derivatives import middle
from warp_spo.recursions.links import Links
from warp_spo.recursions.tracing import Trace
from warp_spo.trace.differentiation import reverse
from warp_spo.trace.evaluation import evaluate
from warp_spo.trace.scalars import ordered

H, WORLDS = 5e-3, 3
WRT = ("qd", "q", FOUND)
ROUNDING = 1e-12  # of the largest entry; 1e-15 measured


def random_tree():
    return furnished(zoo.random_tree(6, 1))


def lifted():
    scene = waisted()
    return scene.with_values(body_gravcomp=np.full(scene.body_count, 0.5))


SCENES = {"tree": random_tree, "geared": lambda: geared.geared_tree("full"), "lifted": lifted}
LIMBS = {"quadruped": quadruped, "waisted": waisted}


def case(scene):
    """What a round reads and leaves, and the gradients by the reverse of the whole graph, by name [world, entry]."""
    rng, n = np.random.default_rng(0), scene.dof_count
    q = states(scene, WORLDS)["q"]
    known = {"q": q, "qd": 20.0 * rng.normal(size=(WORLDS, n)), FOUND: 20.0 * rng.normal(size=(WORLDS, n))}
    known |= {"dt": np.full((WORLDS, 1), H)}
    stores = middle_bias(Trace(Links(scene), "float64", tuple(known)), poses=True)
    seeds = {"out": rng.normal(size=(WORLDS, n)), "mean_out": rng.normal(size=(WORLDS, n)), "q_out": np.zeros(q.shape)}
    left = {name: np.full(array.shape, np.nan) for name, array in seeds.items()}
    inputs = [x for x in ordered([item.value for item in stores]) if x.op == "input" and x.args[0] in WRT]
    graph = inputs[0].graph
    dual = reverse([item.value for item in stores], inputs, [graph.input(f"{x.array} seed", *x.index) for x in stores])
    read = known | {f"{name} seed": array for name, array in seeds.items()}
    outputs = [*(item.value for item in stores), *dual]
    values = evaluate(outputs, lambda name, at: read[name][(slice(None), *at)], "float64")
    for item, value in zip(stores, values, strict=False):
        left[item.array][(slice(None), *item.index)] = value
    wanted = {name: np.zeros(known[name].shape) for name in WRT}
    for x, value in zip(inputs, values[len(stores) :], strict=True):
        wanted[x.args[0]][(slice(None), *x.args[1:])] = value
    given = {"q": left["q_out"], "qd": left["mean_out"], "q_from": q, "qd_from": known["qd"], FOUND: known[FOUND]}
    given |= {"cotangent": seeds["out"], "mean_cotangent": seeds["mean_out"], "dt": known["dt"]}
    return given, wanted


def assert_right(scene):
    given, wanted = case(scene)
    stores = middle.middle_bias_vjp(Trace(Links(scene), "float64", tuple(given)), WRT)
    read = lambda name, at: given[name][(slice(None), *at)]  # noqa: E731
    names = {"out": WRT[0]} | {f"{name}_bar": name for name in WRT[1:]}
    found = {name: np.full(array.shape, np.nan) for name, array in wanted.items()}
    for item, value in zip(stores, evaluate([item.value for item in stores], read, "float64"), strict=True):
        found[names[item.array]][(slice(None), *item.index)] = value
    for name, array in wanted.items():
        np.testing.assert_allclose(found[name], array, atol=ROUNDING * abs(array).max(), err_msg=name)


@pytest.mark.parametrize("scene", [*SCENES, *LIMBS])
def test_the_way_back_is_the_reverse_of_the_graph(scene):
    assert_right((SCENES | LIMBS)[scene]())


@pytest.mark.slow
@pytest.mark.parametrize("name", LIMBS)
def test_limbs_share_the_way_back(name, monkeypatch):
    scene = LIMBS[name]()
    (given, wanted), texts = case(scene), warp_machine.recorded(monkeypatch)
    dyn = spo.Dynamics(scene, WORLDS, "cpu", "float64", granularity="segment")
    assert middle.divides(scene, (), given, WRT) and not middle.divides(lifted(), (), given, WRT)
    given["dt"] = H
    shapes = {key: np.shape(array) for key, array in given.items()}
    more = {f"{key}_bar": wanted[key].shape for key in WRT[1:]}
    program = dyn.programs.find(BIAS_VJP, shapes, wanted[WRT[0]].shape, more, wrt=WRT, apart=True)
    assert program.warps > 1
    for backwards in (False, True):
        got = {"out": warp_machine.run(texts[-1], given, backwards, further := {})} | further
        for key, array in zip(WRT, (got["out"], *(got[f"{key}_bar"] for key in WRT[1:])), strict=True):
            np.testing.assert_allclose(array, wanted[key], atol=ROUNDING * abs(wanted[key]).max(), err_msg=key)


BUGS = {
    "the middle is where the step begins": ("0.5 * h)", "h)"),
    "the mean of the rates": ("0.5 * (way +", "(way +"),
    "how the mean goes on": (" + mean(dof))", ")"),
}


@pytest.mark.parametrize("bug", BUGS)
def test_planted_bugs(bug, monkeypatch):
    symbolic.plant(monkeypatch, middle, "middle_bias_vjp", *BUGS[bug])
    with pytest.raises(AssertionError):
        assert_right(random_tree())
