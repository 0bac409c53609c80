"""The renderer of meshes."""

from .renderer import MeshRenderer as MeshRenderer
