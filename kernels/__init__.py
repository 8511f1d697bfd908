"""Device code, one recursion a file. The kernels of a file for one scalar type share a Warp module, compiled once."""

import types


def declare(file: types.ModuleType, kind: object) -> None:
    """Create every kernel of ``file``, so that the first launch compiles all of them together.

    A kernel that joined its Warp module after the first launch would make Warp compile the whole module again.

    Args:
        file: a module of this package.
        kind: the argument of its factories: the scalar type or, for kernels at node granularity, the node functions of
            that type (:mod:`warp_spo.execution.node.functions`).
    """
    for factory in file.KERNELS:
        factory(kind)
