"""Operators on graphs: block-weighted adjacency matrices, their resolvents, products and sums. No robots."""

from .factorization import Factorization
from .operators import BWA, Blocks, Identity, Operator

__all__ = ["BWA", "Blocks", "Factorization", "Identity", "Operator"]
