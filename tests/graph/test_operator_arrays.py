"""Arrays of the graph layer: kinds, shared and packed weights, empty operators, and mistakes that are explained."""

import numpy as np
import pytest
import torch
import warp as wp

from support.operator_scenes import WORLDS, assert_close, inverse_of, ones, random, scene_of, transposed
from warp_spo.errors import DirectedLoopError
from warp_spo.graph.operators import BWA, Blocks, Identity
from warp_spo.scene.tree import Digraph, Tree


def test_directed_loop_is_refused_on_topology(device):
    with pytest.raises(DirectedLoopError):
        BWA(Digraph([(0, 1), (1, 2), (2, 0)]), [np.zeros((1, 1))] * 3, device=device)


@pytest.mark.parametrize("kind", ["numpy", "torch", "warp"])
def test_matrices_come_in_the_kind_of_the_weights(kind, device):
    s = scene_of("fork")
    make = dict(
        numpy=lambda w: w,
        torch=lambda w: torch.tensor(w, device=wp.device_to_torch(device)),
        warp=lambda w: wp.array(w, dtype=wp.float64, device=device),
    )[kind]
    wanted = dict(numpy=np.ndarray, torch=torch.Tensor, warp=wp.array)[kind]
    E = BWA(s.graph, [None if w is None else make(w) for w in s.weights], device=device if kind == "numpy" else None)
    assert E.device == device and E.dtype is wp.float64 and list(E.dims) == s.dims
    for matrix, twin in (
        (E.dense(), s.E),
        (E.resolvent().dense(), inverse_of(s)),
        ((2 * E.T).dense(), 2 * transposed(s.E)),
    ):
        assert isinstance(matrix, wanted)
        assert_close(
            matrix.cpu().numpy() if kind == "torch" else np.asarray(matrix if kind == "numpy" else matrix.numpy()), twin
        )
    x = torch.tensor(random((WORLDS, E.shape[1])), device=wp.device_to_torch(device))
    assert isinstance(E @ x, torch.Tensor) and isinstance(x @ E, torch.Tensor)
    assert_close((x @ E).cpu().numpy(), np.einsum("wr,wrc->wc", x.cpu().numpy(), s.E))


def test_shared_weights_meet_any_number_of_worlds(device):
    s = scene_of("shared")
    E = BWA(s.graph, s.weights, dims=s.dims, device=device)
    assert E.worlds == 1 and E.dense().shape[0] == 1 and E.resolvent().block(0, 0).shape[0] == 1
    for worlds in (1, 2, 7):
        x = random((worlds, E.shape[1]))
        assert_close(E.resolvent() @ x, x @ np.linalg.inv(np.eye(E.shape[1]) - s.E[0]).T)


def test_packed_weights_are_read_where_they_are(device):
    """Weights rewritten on the device, with gaps between blocks, and world-minor storage."""
    tree, dims = Tree([1, -1, 1]), [2, 3, 1]
    numbers = random((12, WORLDS))
    weights = wp.array(np.zeros((12, WORLDS)), dtype=wp.float64, device=device)
    E = BWA.packed(tree, dims, weights.transpose(), offsets=[2, 8])
    B = Blocks((4, 5), [(2, 0, 2, 2), (0, 3, 2, 1)], weights.transpose(), offsets=[2, 8])
    assert not E.dense().numpy().any()
    weights.assign(numbers)
    wanted = np.zeros((WORLDS, 6, 6))
    wanted[:, 2:5, 0:2] = numbers[2:8].T.reshape(WORLDS, 3, 2)
    wanted[:, 2:5, 5:6] = numbers[8:11].T.reshape(WORLDS, 3, 1)
    np.testing.assert_array_equal(E.dense().numpy(), wanted)
    assert_close(E.resolvent().dense().numpy(), np.linalg.inv(np.eye(6) - wanted))
    wanted = np.zeros((WORLDS, 4, 5))
    wanted[:, 2:4, 0:2] = numbers[2:6].T.reshape(WORLDS, 2, 2)
    wanted[:, 0:2, 3:4] = numbers[8:10].T.reshape(WORLDS, 2, 1)
    np.testing.assert_array_equal(B.dense().numpy(), wanted)
    np.testing.assert_array_equal(B.T.dense().numpy(), transposed(wanted))


def test_overlapping_blocks_add(device):
    weights = wp.array(np.arange(8.0)[None], dtype=wp.float64, device=device)
    B = Blocks((3, 2), [(0, 0, 2, 2), (1, 0, 2, 2)], weights, kind="NumPy")
    np.testing.assert_array_equal(B.dense()[0], [[0, 1], [2 + 4, 3 + 5], [6, 7]])
    np.testing.assert_array_equal(B.T.dense()[0], B.dense()[0].T)


def test_operators_without_rows_or_columns(device):
    B = Blocks((3, 0), [], wp.zeros((1, 0), dtype=wp.float64, device=device), kind="NumPy")
    np.testing.assert_array_equal(B @ np.zeros((WORLDS, 0)), np.zeros((WORLDS, 3)))
    assert (B.T @ np.zeros((WORLDS, 3))).shape == (WORLDS, 0)
    assert (B @ B.T).dense().shape == (1, 3, 3) and (B.T @ B).dense().shape == (1, 0, 0)


def chain_of_two(**arguments):
    return BWA(Tree([-1, 0]), [None, np.ones((2, 3))], **arguments)


REFUSED = {
    "graph": (
        lambda: BWA([-1, 0], [None, ones(1, 1)]),
        TypeError,
        "graph is of type list; expected a Tree or a Digraph",
    ),
    "count": (
        lambda: BWA(Tree([-1, 0]), [ones(1, 1)]),
        ValueError,
        r"1 weights; expected 2, one a node \(None for roots\)",
    ),
    "edge count": (lambda: BWA(Digraph([(0, 1)]), [None, ones(1, 1)]), ValueError, "2 weights; expected 1, one a edge"),
    "missing": (lambda: BWA(Tree([-1, 0]), [None, None], dims=[1, 1]), ValueError, r"weights\[1\] is None; expected"),
    "root": (lambda: BWA(Tree([-1, 0]), [ones(1, 1)] * 2), ValueError, "node 0 is a root; expected None"),
    "list": (lambda: BWA(Tree([-1, 0]), [None, [[1.0]]]), TypeError, "is of type list; expected a torch tensor"),
    "one axis": (
        lambda: BWA(Tree([-1, 0]), [None, ones(3)]),
        ValueError,
        r"shape \(3,\); expected \[world, rows, columns\]",
    ),
    "sizes": (
        lambda: BWA(Tree([-1, 0, 1]), [None, ones(2, 3), ones(2, 2)]),
        ValueError,
        r"weights\[2\] has 2 rows, which is the size of node 1; expected 3 by weights\[1\]",
    ),
    "dims": (
        lambda: chain_of_two(dims=[2, 2]),
        ValueError,
        r"weights\[1\] has 3 columns.*node 1; expected 2 by dims\[1\]",
    ),
    "dims count": (lambda: chain_of_two(dims=[2]), ValueError, "1 dims; expected 2"),
    "dims zero": (lambda: chain_of_two(dims=[2, 0]), ValueError, r"dims\[1\] is 0; expected 1 or more"),
    "dims unknown": (lambda: BWA(Tree([-1, -1]), [None, None]), ValueError, r"size of nodes \[0, 1\]; expected dims="),
    "worlds": (
        lambda: BWA(Tree([-1, 0, 0]), [None, ones(3, 1, 1), ones(4, 1, 1)]),
        ValueError,
        r"\[3, 4\] worlds; expected one number of worlds",
    ),
    "dtype": (lambda: chain_of_two(dtype="float16"), ValueError, 'expected "float32" or "float64"'),
    "torch dtype": (
        lambda: BWA(Tree([-1, 0]), [None, torch.ones(1, 1)], dtype="float64"),
        ValueError,
        r"weights\[1\] is a torch array float32",
    ),
    "torch grad": (
        lambda: BWA(Tree([-1, 0]), [None, torch.ones(1, 1, requires_grad=True)]),
        ValueError,
        r"weights\[1\] requires grad",
    ),
    "dims true": (lambda: chain_of_two(dims=[2, True]), ValueError, r"dims\[1\] is True; expected 1 or more, an int"),
    "half a power": (lambda: chain_of_two().power(0.5), ValueError, "exponent is 0.5; expected an integer, 0 or more"),
    "block by name": (lambda: chain_of_two().resolvent().block("a", 0), ValueError, "block: i is 'a'; expected a node"),
    "negative power": (lambda: chain_of_two().power(-1), ValueError, "exponent is -1; expected an integer, 0 or more"),
    "block": (lambda: chain_of_two().resolvent().block(0, 2), ValueError, "j is 2; expected a node, 0 to 1"),
    "x size": (lambda: chain_of_two() @ ones(3, 4), ValueError, r"BWA.apply: x .*\(3, 4\); expected \(any, 5\)"),
    "x worlds": (
        lambda: BWA(Tree([-1, 0]), [None, ones(3, 1, 1)]) @ ones(4, 2, 1),
        ValueError,
        r"\(4, 2, 1\); expected \(3, 2, any\)",
    ),
    "x axes": (lambda: chain_of_two() @ ones(5), ValueError, r"\(5,\); expected \(any, 5\)"),
    "x kind": (lambda: chain_of_two() @ [1.0], TypeError, "x is of type list"),
    "x grad": (lambda: chain_of_two() @ torch.zeros(1, 5).double().requires_grad_(), ValueError, "x requires grad"),
    "x dtype": (lambda: chain_of_two() @ torch.zeros(1, 5), ValueError, "torch array float32.*dtype='float32'"),
    "array @ 3-d": (lambda: ones(1, 5, 2) @ chain_of_two(), ValueError, r"write operator.T @ array"),
    "array +": (lambda: ones(1, 5) + chain_of_two(), TypeError, r"BWA \+ ndarray: expected an operator; use dense\(\)"),
    "array -": (lambda: ones(1, 5) - chain_of_two(), TypeError, r"BWA - ndarray: expected an operator; use dense\(\)"),
    "+ tensor": (lambda: chain_of_two() + torch.zeros(1), TypeError, r"BWA \+ Tensor: expected an operator"),
    "tensor +": (lambda: torch.zeros(1) + chain_of_two(), TypeError, r"BWA \+ Tensor: expected an operator"),
    "- number": (lambda: chain_of_two() - 1, TypeError, r"BWA - int: expected an operator"),
    "* array": (lambda: ones(5) * chain_of_two(), TypeError, r"BWA \* ndarray: expected a number"),
    "warp +": (lambda: wp.zeros(5, device="cpu") + chain_of_two(), TypeError, "add"),
    "sum shape": (
        lambda: chain_of_two() + Identity(4),
        ValueError,
        r"BWA\(5 x 5, any worlds, float64, cpu\) and Identity\(4 x 4.*differ in shape",
    ),
    "product shape": (
        lambda: chain_of_two() @ Identity(4),
        ValueError,
        r"BWA\(5 x 5.* @ Identity\(4 x 4.*missing a .T",
    ),
    "sum dtype": (lambda: chain_of_two() + Identity(5, dtype="float32"), ValueError, "differ in device or dtype"),
    "product worlds": (
        lambda: Blocks.diagonal([ones(3, 1, 1)]) @ Blocks.diagonal([ones(4, 1, 1)]),
        ValueError,
        "one has 3 worlds, Blocks",
    ),
    "block place": (
        lambda: Blocks((2, 2), [(1, 0, 2, 2)], wp.zeros((1, 4), dtype=wp.float64, device="cpu")),
        ValueError,
        r"2 x 2 at \(1, 0\) reaches out of a matrix of 2 x 2",
    ),
    "block offset": (
        lambda: Blocks((2, 2), [(0, 0, 2, 2)], wp.zeros((1, 4), dtype=wp.float64, device="cpu"), offsets=[1]),
        ValueError,
        "block 0 takes scalars 1 to 4 of weights, which has 4 a world",
    ),
    "offset count": (
        lambda: BWA.packed(Tree([-1, 0]), [1, 1], wp.zeros((1, 4), dtype=wp.float64, device="cpu"), offsets=[1, 2]),
        ValueError,
        "2 offsets; expected one for each of the 1 blocks",
    ),
    "packed": (
        lambda: BWA.packed(Tree([-1, 0]), [1, 1], np.zeros((1, 1))),
        ValueError,
        r"expected a Warp array \[world or 1, scalar\]",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case):
    action, error, words = REFUSED[case]
    with pytest.raises(error, match=words):
        action()


def test_errors_name_ways_that_are_taken():
    """An array of one world for an operator of any number of worlds, and one of no numbers."""
    E = BWA(Digraph([(0, 1)]), [np.eye(1)])
    with pytest.raises(ValueError, match="shape of one world; stack one for each world along a first axis"):
        E @ np.ones(2)
    with pytest.raises(ValueError, match=r"on meta; expected it on cpu; .*torch.zeros_like\(x, device='cpu'\)"):
        E @ torch.ones((3, 2), device="meta", dtype=torch.float64)
