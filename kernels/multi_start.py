"""Searches: a thread repeats straight-line code from one of several starts and keeps the best that it has found.

There is a thread for each (seed, world), worlds side by side. A second kernel takes the best seed of each world.
"""

import functools

import warp as wp

from .elementary import C_TYPE, NATIVE
from .fields import define_fields


def assemble_search(fields: list[str], start: str, step: str, coordinates: int, given: bool, T: type) -> str:
    """Return the native code of one thread.

    Args:
        fields: names of the arrays of :mod:`.fields` that the statements read, as ``FIELD(name, entry)``.
        start: statements that set ``next_row`` from ``share_row``, ``given_row`` and ``first_row``.
        step: statements that set ``error_row[0]``, of ``q_row``, and ``next_row``, what follows it.
        coordinates: entries of q.
        given: the first seed starts at the caller's q.
    """
    c, every = C_TYPE[T], f"for (int i = 0; i < {coordinates}; ++i)"
    return "\n".join(
        [
            NATIVE[c],
            "const long long count = target.shape[0], world = thread % count, seed = thread / count;",
            f"const {c}* target_row = target.data + world * (target.shape[1] * target.shape[2]);",
            f"const {c}* share_row = share.data + seed * {coordinates};",
            *([f"const {c}* given_row = given.data + world * {coordinates};"] if given else []),
            f"const {c} weight_row[1] = {{weight}}, first_row[1] = {{({c}){'(seed == 0)' if given else '0'}}};",
            *define_fields(fields, c),
            f"{c} q_row[{coordinates}], next_row[{coordinates}], best_row[{coordinates}], error_row[1], best = nan;",
            f"{{\n{start}\n}}",
            f"{every} q_row[i] = best_row[i] = next_row[i];",
            "for (int turn = 0; turn <= (int)iterations; ++turn) {",
            step,
            "const bool better = error_row[0] < best || best != best;",
            "best = better ? error_row[0] : best;",
            f"{every} {{ best_row[i] = better ? q_row[i] : best_row[i]; q_row[i] = next_row[i]; }}",
            "}",
            f"{every} found.data[i * (long long)worlds + thread] = best_row[i];",
            "errors.data[thread] = best;",
            *(["#undef FIELD"] if fields else []),
            "",
        ]
    )


@functools.cache
def select_best(T: type) -> wp.Kernel:
    """Write the coordinates and the error of the seed with the least error, the first of equals; one thread a world.

    A seed whose error is NaN counts only if all are.
    """

    @wp.kernel(module=f"warp_spo_searches_{T.__name__}", enable_backward=False)
    def kernel(
        errors: wp.array2d[T],  # [seed, world]
        found: wp.array3d[T],  # [coordinate, seed, world]
        q_out: wp.array2d[T],
        error_out: wp.array[T],
    ):
        world = wp.tid()
        best = int(0)
        for seed in range(1, errors.shape[0]):
            error, least = errors[seed, world], errors[best, world]
            if error < least or (error == error and least != least):
                best = seed
        error_out[world] = errors[best, world]
        for i in range(found.shape[0]):
            q_out[world, i] = found[i, best, world]

    return kernel


@functools.cache
def take_positions(T: type) -> wp.Kernel:
    """Copy target poses without their quaternions, in whose place the neutral one is written."""

    @wp.kernel(module=f"warp_spo_searches_{T.__name__}", enable_backward=False)
    def kernel(targets: wp.array3d[T], out: wp.array3d[T]):
        world, frame = wp.tid()
        for i in range(3):
            out[world, frame, i] = targets[world, frame, i]
            out[world, frame, 3 + i] = T(0.0)
        out[world, frame, 6] = T(1.0)

    return kernel


KERNELS = (select_best, take_positions)
