"""Elementary hinges: one file a kind, each an object that answers all that the recursions ask about a hinge.

A kind of hinge by its public name (revolute, universal, d6, ...) is a sequence of elementary ones. No other room asks
which kind a hinge is; :class:`.kind.Kind` lists the questions.
"""
