"""Ray-cast images of one robot on the ground, from the server's reply to ``render``.

One ray per pixel is intersected with each shape, inside the rectangle around its silhouette. With numpy an image takes
milliseconds. World frame: z up; SI units.
"""

from .viewer import Viewer

__all__ = ["Viewer"]
