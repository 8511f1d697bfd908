"""Scenes: bodies, hinges and loops that a user describes, the tree that they form, and frames on bodies."""

from .parts import Body, Coupling, Hinge, Loop
from .scene import Scene
from .tree import Digraph, Tree

__all__ = ["Body", "Coupling", "Digraph", "Hinge", "Loop", "Scene", "Tree"]
