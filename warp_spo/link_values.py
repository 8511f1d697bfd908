"""What links are made of where it varies: one kernel of a scene computes it in float64, and rounds once, at the store.

It runs when a value is set, not when an operation is called.
"""

from __future__ import annotations

import warp as wp

from .kernels import straight
from .parameters import Derived, Parameters, spread
from .recursions.links import Links
from .trace.emit import Emitter, Store, literals
from .trace.graph import ordered


def table(parameters: Parameters, links: Links, name: str) -> wp.array:
    """The scalars ``links.tables[name]`` as [entry, world], with stride 0 where all worlds share them."""

    def build() -> Derived:
        values = list(links.tables[name])
        sources = list(dict.fromkeys(scalar.args[0] for scalar in ordered(values) if scalar.op == "input"))
        T, device, worlds = parameters.dtype, parameters.device, parameters.rows(sources)
        own = wp.empty((len(values), worlds), dtype=T, device=device)
        inputs = [worlds, *(parameters.entries(source, worlds) for source in sources)]
        kernel = _kernel(name, values, sources, T)
        fill = lambda: wp.launch(kernel, worlds, inputs, [own], device=device)  # noqa: E731
        return Derived([spread(own, 1, parameters.worlds)], sources, fill)

    return parameters.derived(name, build)[0]


def _kernel(name: str, values: list, sources: list[str], T: type) -> wp.Kernel:
    """A thread a world: Newton's values [entry, world] in, the table [entry, world] out."""
    emitter = Emitter(
        "float64",
        lambda array, entry: f"FIELD({array}, {entry})",
        lambda array, entry, value: f"out.data[({entry}) * (long long)worlds + world] = ({straight.C_TYPE[T]}){value};",
        lambda array, index: index[0],
        late=sources,
    )
    listing = emitter.region([Store("out", (entry,), value) for entry, value in enumerate(values)])
    native = straight.per_world(sources, literals(listing, "float64"))
    arrays = [(source, 2) for source in sources] + [("out", 2)]
    return straight.kernel(f"links_{name}", native, arrays, T, wide=tuple(sources))
