"""World models: T3VIP, its geometry, training, validation and pictures."""

from worldmodel.checkpoint import load_model

__all__ = ["load_model"]
