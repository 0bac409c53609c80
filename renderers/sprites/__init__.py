"""The renderer of sprites."""

from .renderer import SpriteRenderer as SpriteRenderer
