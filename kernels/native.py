"""Warp functions and kernels whose bodies are generated C++."""

import hashlib
import linecache

import warp as wp

MASKS = ("prescribed",)  # names of the arrays [world, dof] that hold booleans
CHOICES = ("chosen",)  # names of the arrays [world] that hold booleans
THREAD = """\
#if defined(__CUDA_ARCH__)
const long long thread = (long long)blockIdx.x * blockDim.x + threadIdx.x;
#else
const long long thread = index;
#endif
"""
"""The number of the thread, in 64 bits. On CUDA it needs a grid of one axis, as ``runtime.launches`` gives."""
INTEGERS = (
    "place",
    "shifts",
    "status",
    "block_entries",
    "near",
    "near_pairs",
    "shape_rows",
    "face_starts",
    "face_corners",
    "counts",
)
"""Names of the arrays that hold integers; each has one axis."""


def function(name: str, native: str, arguments: dict[str, type], result: type | None = None) -> wp.Function:
    """Return a Warp function that runs the C++ text ``native``.

    Args:
        name: the function's name.
        native: the body.
        arguments: the type of each argument, by name.
        result: the type of the result; None if the function returns nothing.
    """
    types = {f"type_of_{argument}": kind for argument, kind in arguments.items()} | {"type_of_result": result}
    declared = ", ".join(f"{argument}: type_of_{argument}" for argument in arguments)
    source = f"@wp.func_native(native)\ndef {name}({declared}){' -> type_of_result' if result else ''}: ...\n"
    file = f"<{name}>"
    linecache.cache[file] = len(source), None, source.splitlines(True), file  # Warp reads the source from this cache
    space = types | {"wp": wp, "native": native, "__name__": name}
    exec(compile(source, file, "exec"), space)
    return space[name]


def kernel(
    name: str,
    native: str,
    arrays: list[tuple[str, int]],
    T: type,
    registers: int | None = None,
    wide: tuple[str, ...] = (),
    shared: int = 0,
) -> wp.Kernel:
    """Return a kernel in which each thread runs the C++ text ``native``.

    The text may use ``thread``, its number, and on CUDA ``blockIdx.x``, however many threads are launched.

    Args:
        name: the beginning of the kernel's name; a hash of ``native`` follows.
        native: the body.
        arrays: the name and the number of axes of each argument after ``worlds``; an argument without axes is a number.
            The arrays of INTEGERS hold integers, those of MASKS and CHOICES booleans, the others scalars of type ``T``.
        registers: the largest number of registers that a thread may use; None sets no limit.
        wide: the names of the arrays [entry, world] that hold float64 whatever ``T`` is.
        shared: the bytes of shared memory that a launch asks for, beside what ``native`` declares.
    """
    key = f"{name}_{hashlib.sha256(native.encode()).hexdigest()[:16]}"
    types = {array: "table" if array in INTEGERS else f"array{axes}" for array, axes in arrays}
    types |= {array: "mask" for array in types if array in MASKS}
    types |= {array: "choice" for array in types if array in CHOICES} | {array: "wide" for array in wide}
    declared = ", ".join(f"{array}: {kind}" for array, kind in types.items())
    source = f"""def native(index: int, worlds: int, {declared}): ...


def {key}(worlds: int, {declared}):
    index = wp.tid()
    native(index, worlds, {", ".join(array for array, _ in arrays)})
"""
    file = f"<{key}>"
    linecache.cache[file] = len(source), None, source.splitlines(True), file  # Warp reads the source from this cache
    space = {f"array{axes}": wp.array(dtype=T, ndim=axes) for axes in range(1, 5)} | {
        "array0": T,
        "table": wp.array(dtype=int, ndim=1),
        "mask": wp.array(dtype=wp.bool, ndim=2),
        "choice": wp.array(dtype=wp.bool, ndim=1),
        "wide": wp.array(dtype=wp.float64, ndim=2),
        "wp": wp,
        "__name__": key,
    }
    exec(compile(source, file, "exec"), space)
    space["native"] = wp.func_native(THREAD + native)(space["native"])
    options = {} if registers is None else {"cuda_max_registers": registers}
    decorate = wp.kernel(name=key, module=f"warp_spo_{key}", enable_backward=False, grid_stride=False, **options)
    made = decorate(space[key])
    made.module.options["fuse_fp"] = False  # the text says which products and sums are fused, see trace.emission
    made.counts_blocks = True
    if shared:
        made.adj.get_total_required_shared = lambda: shared
    return made
