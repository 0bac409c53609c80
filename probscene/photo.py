"""``Photo``, the name of ``CameraEffects`` in model files of before 0.2, which runs keep."""

from .camera_effects import CameraEffects as Photo

__all__ = ["Photo"]
