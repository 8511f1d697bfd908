"""Scenes: bodies, hinges and loops that a user describes, the tree that they form, and frames on bodies."""

from .contacts import Contact
from .ground import HeightField, Plane
from .parts import Body, Coupling, Hinge, Loop
from .scene import Scene
from .tree import Digraph, Tree

__all__ = ["Body", "Contact", "Coupling", "Digraph", "HeightField", "Hinge", "Loop", "Plane", "Scene", "Tree"]
