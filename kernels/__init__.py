"""Device code, one recursion a file. A file's kernels of one scalar type share a Warp module, compiled once."""


def declare(file, T) -> None:
    """Make every kernel of ``file`` for scalars of type ``T``, so that the first launch compiles them all together.

    A kernel that joins its module after the first launch would have the whole module compiled again.
    """
    for factory in file.KERNELS:
        factory(T)
