"""Closed loops and couplings: constraint rows, embedding of loops as nodes of the tree, and multipliers."""
