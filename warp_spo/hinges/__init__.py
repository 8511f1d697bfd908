"""Elementary hinges: one file a kind, each an object that answers all that the recursions ask about a hinge.

A kind of hinge by its public name (revolute, universal, d6, ...) is a sequence of elementary ones. No other room asks
which kind a hinge is; :class:`.hinge_type.HingeType` lists the questions.
"""
