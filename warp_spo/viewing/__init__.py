"""Pictures: films, strips of robots (``films``), charts (``charts``), pages of a browser (``robot_view``, ...)."""

from .films import Camera, camera_of, pictures, save, save_strip
from .shapes import Primitive, primitives

__all__ = ["Camera", "Primitive", "camera_of", "pictures", "primitives", "save", "save_strip"]
