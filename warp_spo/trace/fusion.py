"""Fusion: which products and sums of a region are one statement, FUSED_T(a, b, c) = a b + c.

The choice depends on the formulas only, so that every kernel with the same formulas rounds alike.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

from .scalars import Scalar, Value

NEAR = 32  # scalars from the product that begins with another summand to the sum; with more, values live longer


class Chain(NamedTuple):
    """A sum ``sign * first + terms``, whose terms are added in this order; a term has a sign of its own.

    ``products`` are the keys of terms that are products and need no statement.
    """

    sign: int
    first: Value
    terms: list[tuple[int, Scalar]]
    products: set[tuple]


def choose_chains(
    scalars: list[Scalar], stored: set[tuple], taken: dict[tuple, Scalar], fused: set[tuple]
) -> tuple[dict[tuple, Chain], set[tuple]]:
    """Return sums in which a product that would have a statement of its own begins with another summand instead.

    x + (a b + c d) takes a product and two sums; (x + c d) + a b two fused statements.

    Args:
        scalars: the scalars of a region.
        stored: the keys of those that are stored or used later.
        taken, fused: what :func:`choose_products` returned.

    Returns:
        The chains by the keys of the sums, and the keys of the scalars inside them, which need no statement.
    """
    uses: Counter = Counter(value.key for x in scalars for value in x.args if value.__class__ is Scalar)
    known, inside = {x.key for x in scalars}, set()  # type: set[tuple], set[tuple]
    barren: set[tuple] = set()  # keys of what holds no product; it stays so, because ``inside`` only grows
    first: dict[
        tuple, int
    ] = {}  # by the key of a sum, the number of the product that is found in it, until ``inside`` grows

    def terms_of(value: Value, sign: int, oldest: int) -> list[tuple[int, Scalar]] | None:
        """Return the terms of a sum that is used once, a product without a statement first.

        None: it has none, or the first that is found is older than the number ``oldest``.

        Sums are searched depth first, with a list of what is left to try: they may have thousands of terms. The trail
        of a value holds the sums around it and the terms beside it, the nearest first.
        """
        if first.get(value.key, oldest) < oldest:
            return None
        untried: list[tuple[Value, int, Any]] = [(value, sign, None)]
        while untried:
            value, sign, trail = untried.pop()
            if value.__class__ is not Scalar or value.key in barren:
                continue
            barren.add(value.key)  # unless a product is found in it
            if uses[value.key] != 1 or value.key in stored or value.key in inside:
                continue
            if value.key not in known or (value.op == "mul" and value.key in fused):
                continue
            if value.op == "mul":
                number, found = value.number, [(sign, value)]
                barren.discard(value.key)
                while trail is not None:
                    key, term, trail = trail
                    found.append(term)
                    barren.discard(key)
                    first[key] = number
                return found if number >= oldest else None
            if value.op in ("add", "sub"):
                a, b = value.args
                signs = sign, -sign if value.op == "sub" else sign
                product = taken.get(value.key)
                for at, inner, other in ((1, b, a), (0, a, b)):  # the last one is tried first
                    if inner is not product and (product is not None or other.__class__ is Scalar):
                        untried.append((inner, signs[at], (value.key, (signs[1 - at], other), trail)))
        return None

    chains: dict[tuple, Chain] = {}
    for scalar in sorted(scalars, key=lambda scalar: -scalar.number):  # longer chains first
        if scalar.op not in ("add", "sub") or scalar.key in taken or scalar.key in inside:
            continue
        a, b = scalar.args
        signs = 1, -1 if scalar.op == "sub" else 1
        for at, (inner, other) in enumerate(((b, a), (a, b))):
            if inner.__class__ is not Scalar or inner.op not in ("add", "sub"):
                continue
            found = terms_of(inner, signs[1 - at], scalar.number - NEAR)
            if found is not None:
                products = {term.key for _, term in found if term.key in fused or term is found[0][1]}
                chains[scalar.key] = Chain(signs[at], other, found, products)
                inside |= {found[0][1].key} | sums_of(inner, {term.key for _, term in found})
                first.clear()
                break
    return chains, inside


def sums_of(value: Scalar, terms: set[tuple]) -> set[tuple]:
    """Return the keys of the sums between ``value`` and its ``terms``."""
    found, rest = set(), [value]
    while rest:
        one = rest.pop()
        if one.key not in terms:
            found.add(one.key)
            rest += [each for each in one.args if each.__class__ is Scalar]
    return found


def choose_products(scalars: list[Scalar], stored: set[tuple]) -> tuple[dict[tuple, Scalar], set[tuple]]:
    """Return the product that each sum or difference takes, by the key of the sum, and the keys of these products.

    A product is taken where sums and differences alone use it, so that it needs no statement of its own. The choice
    depends on the formulas only. Products with few uses come first, of equal ones the later.

    Args:
        scalars: the scalars of a region.
        stored: the keys of those that are stored or used later.
    """
    uses: dict[tuple, list[Scalar]] = {}
    for scalar in scalars:
        for value in scalar.args:
            if value.__class__ is Scalar:
                uses.setdefault(value.key, []).append(scalar)
    products = [scalar for scalar in scalars if scalar.op == "mul" and scalar.key not in stored]
    taken: dict[tuple, Scalar] = {}
    fused = {product.key for product in products if product.key not in uses}  # earlier regions have taken them
    for product in sorted(products, key=lambda product: (len(uses.get(product.key, ())), -product.number)):
        takers = {taker.key: taker for taker in uses.get(product.key, ())}
        sums = len(takers) == len(uses.get(product.key, ())) and all(x.op in ("add", "sub") for x in takers.values())
        if sums and not takers.keys() & taken.keys():
            taken |= dict.fromkeys(takers, product)
            fused.add(product.key)
    return taken, fused
