"""The spatial operators of robots in random states, and the comparison with dense matrices."""

import functools

import numpy as np

import warp_spo as spo
from warp_spo.recursions import operators as recursion
from warp_spo.recursions.model.links import Links
from warp_spo.recursions.model.tracing import Trace
from warp_spo.trace.evaluation import evaluate

from . import laws, zoo
from .granularities import of_random_scenes
from .robots import ROBOTS

IDENTITY = {
    "float64": 1e-11,  # products of a dozen operators, relative to the largest entry; cond(M) of the worst robot is 1e5
    "float32": 2e-3,  # M M^-1 = 1 loses cond(M) eps; measured 4e-4
}
SWEEP = {
    "float64": 1e-13,  # relative 2-norm, as promised
    "float32": 5e-6,  # the weights' rounding, times the depth of the tree
}
SCENES = ROBOTS | {name: zoo.SCENES[name] for name in ("tree20", "forest", "every_d6", "chain_free")}
DENSE = ("E_phi", "phi", "E_psi", "psi", "H", "K", "D", "G", "M", "P", "Delta")


@functools.cache
def scene_of(name):
    return (zoo.SCENES | SCENES)[name]()


@functools.cache
def _operators(name, worlds, dtype, device):
    granularity = of_random_scenes()  # at tree each operator of each scene is a kernel: test_expressions takes some
    dyn = spo.Dynamics(zoo.varied(scene_of(name), worlds), worlds, device=device, dtype=dtype, granularity=granularity)
    q = laws.states(dyn.scene, worlds, dtype=dtype)["q"]
    return dyn, dyn.operators(q), q


def operators(name, worlds, dtype, device):
    return _operators(name, worlds, dtype, device.alias)


def close(got, wanted, tolerance):
    got, wanted = (laws.numbers(x.dense() if isinstance(x, spo.Operator) else x) for x in (got, wanted))
    assert laws.error(got, np.broadcast_to(wanted, got.shape)) <= tolerance


def inverse_mass(o):
    """[I - H psi K]* D^-1 [I - H psi K]"""
    half = spo.Identity(o.H.shape[0], o.H.device, o.H.dtype) - o.H @ o.psi @ o.K
    return half.T @ o.D_inverse @ half


def fused(name, worlds, device, dtype="float64", seed=0, granularity="tree", **options):
    """Dynamics that applies expressions by one kernel each, its operators and q."""
    scene = scene_of(name) if isinstance(name, str) else name
    dyn = spo.Dynamics(scene, worlds, device=device, dtype=dtype, granularity=granularity, **options)
    q = laws.states(scene, worlds, seed, dtype)["q"]
    return dyn, dyn.operators(q), q


def traced(scene, operator, x, q):
    """``operator x`` as the trace has it, evaluated by NumPy: [world, row]."""
    arrays = {"q": q, "x": x}
    stores = recursion.expression(Trace(Links(scene), "float64", ("q", "x")), operator.expression)
    found = evaluate([item.value for item in stores], lambda name, index: arrays[name][:, index[0]])
    result = np.full((len(q), operator.shape[0]), np.nan)
    for item, value in zip(stores, found, strict=True):
        result[:, item.index[0]] = value
    return result
