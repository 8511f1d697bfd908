"""The variable parts of links: a kernel of the scene computes them in float64 and rounds each of them once.

The kernel runs when a value is set, not when an operation is called.
"""

from __future__ import annotations

import warp as wp

from ..kernels import native, straight_line
from ..kernels.fields import place_in_tile
from ..kernels.long_results import WARP_SIZE
from ..recursions.model.links import Links
from ..runtime import launches
from ..runtime.memory import broadcast_worlds
from ..trace.differentiation import reverse
from ..trace.emission import Emitter, Store, render
from ..trace.scalars import ordered
from .parameters import DerivedArrays, Parameters

LONGEST = 96  # entries that one kernel computes: twice as many take much more than twice as long to compile


def table(parameters: Parameters, links: Links, name: str) -> wp.array:
    """Return the scalars ``links.tables[name]`` as [tile, entry, world of the tile], with 32 worlds in a tile.

    Where all worlds share them, the stride of tiles is 0.
    """

    def build() -> DerivedArrays:
        values = list(links.tables[name])
        sources = list(dict.fromkeys(scalar.args[0] for scalar in ordered(values) if scalar.op == "input"))
        T, device, worlds = parameters.dtype, parameters.device, parameters.rows(sources)
        filled, parts = WARP_SIZE if worlds == 1 else worlds, []
        own = wp.zeros((-(-filled // WARP_SIZE), len(values), WARP_SIZE), dtype=T, device=device)
        for first in range(0, len(values), LONGEST):
            kernel, read = _kernel(name, values, range(first, min(first + LONGEST, len(values))), T)
            parts.append((kernel, [filled, *(parameters.entries(source, filled) for source in read)]))

        def fill() -> None:
            for kernel, inputs in parts:
                launches.launch(kernel, filled, inputs, [own], device=device)

        return DerivedArrays([broadcast_worlds(own, 0, -(-parameters.worlds // WARP_SIZE))], sources, fill)

    return parameters.derived_arrays(name, build)[0]


def _kernel(name: str, values: list, entries: range, T: type) -> tuple[wp.Kernel, list[str]]:
    """Return the kernel that computes ``entries`` of a table, and the names of Newton's values that it reads.

    One thread works on a world.
    """
    read = ordered([values[entry] for entry in entries])
    sources = list(dict.fromkeys(scalar.args[0] for scalar in read if scalar.op == "input"))
    emitter = Emitter(
        "float64",
        lambda array, entry: f"FIELD({array}, {entry})",
        lambda array, entry, value: (
            f"out.data[{place_in_tile(entry, len(values))}] = ({straight_line.C_TYPE[T]}){value};"
        ),
        lambda array, index: index[0],
        late=sources,
        fuses=True,
    )
    listing = emitter.region([Store("out", (entry,), values[entry]) for entry in entries])
    text = straight_line.assemble_per_world(sources, render(listing, "float64"))
    arrays = [(source, 2) for source in sources] + [("out", 3)]
    return native.kernel(f"links_{name}", text, arrays, T, wide=tuple(sources)), sources


def pull_back(parameters: Parameters, links: Links, cotangent: wp.array, gradients: dict[str, wp.array]) -> None:
    """Write the gradients with respect to Newton's values, given those with respect to the links.

    The kernel computes in float64 and rounds once.

    Args:
        parameters: the values of the scene.
        links: the links of the scene.
        cotangent: the gradient with respect to the table "value" of the links [world, entry].
        gradients: by the names of Newton's values, the arrays [world, entry] for the results.
    """
    kernel, sources = _reverse(parameters, links, tuple(gradients))
    inputs = [parameters.worlds, *(parameters.entries(source, parameters.worlds) for source in sources), cotangent]
    launches.launch(kernel, parameters.worlds, inputs, list(gradients.values()), device=parameters.device)


def _reverse(parameters: Parameters, links: Links, names: tuple[str, ...]) -> tuple[wp.Kernel, list[str]]:
    """Return the kernel for a list of names and the names of its inputs; ``links`` keeps them for the next call."""
    key = names, parameters.dtype
    if key not in links.reverses:
        values = list(links.tables["value"])
        inputs = [scalar for scalar in ordered(values) if scalar.op == "input"]
        seeds = [links.graph.input("cotangent", slot) for slot in range(len(values))]
        derivatives = dict(zip((x.args for x in inputs), reverse(values, inputs, seeds), strict=True))
        sizes = {name: links.scene.values[name][0].size for name in names}
        stores = [Store(name, (i,), derivatives.get((name, i), 0.0)) for name in names for i in range(sizes[name])]
        read = ordered([item.value for item in stores])
        sources = list(dict.fromkeys(x.args[0] for x in read if x.op == "input" and x.args[0] != "cotangent"))
        links.reverses[key] = _reverse_kernel(stores, sources, len(values), sizes, parameters.dtype), sources
    return links.reverses[key]


def _reverse_kernel(stores: list[Store], sources: list[str], size: int, sizes: dict[str, int], T: type) -> wp.Kernel:
    """Return the kernel that makes ``stores``; ``size`` is the length of the cotangent, ``sizes`` of the gradients."""

    def load(array: str, entry: str) -> str:
        return f"FIELD({array}, {entry})" if array in sources else f"{array}.data[world * {size} + {entry}]"

    def store(array: str, entry: str, value: str) -> str:
        return f"{array}_bar.data[world * {sizes[array]} + {entry}] = ({straight_line.C_TYPE[T]})({value});"

    emitter = Emitter("float64", load, store, lambda array, index: index[0], late=(*sources, "cotangent"), fuses=True)
    text = straight_line.assemble_per_world(sources, render(emitter.region(stores), "float64"))
    arrays = [(source, 2) for source in sources] + [("cotangent", 2)] + [(f"{name}_bar", 2) for name in sizes]
    return native.kernel("links_reverse", text, arrays, T, wide=tuple(sources))
