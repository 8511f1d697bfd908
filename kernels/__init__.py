"""Device code, one recursion a file. A file's kernels of one scalar type share a Warp module, compiled once."""


def declare(file, kind) -> None:
    """Make every kernel of ``file``, so that the first launch compiles them all together.

    ``kind``: the scalar type or, for kernels at node granularity, the steps of that type; what the factories take.

    A kernel that joins its module after the first launch would have the whole module compiled again.
    """
    for factory in file.KERNELS:
        factory(kind)
