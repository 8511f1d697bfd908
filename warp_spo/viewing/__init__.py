"""Pictures: films and strips of robots (``films``), charts of figures (``charts``), Newton's viewer (``viewer``)."""

from .films import Camera, camera_of, pictures, save, save_strip
from .shapes import Primitive, primitives

__all__ = ["Camera", "Primitive", "camera_of", "pictures", "primitives", "save", "save_strip"]
