"""The clips that a model is scored on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldmodel.clips import Clips, ClipSource


@dataclass(frozen=True)
class ValidationSet:
    """A fixed set of held-out clips.

    Args:
        source: where they come from.
        clips: how many, spread evenly over the data.
        frames: of each clip, context included.
        context: how many frames the model sees.
        batch: clips at a time.
    """

    source: ClipSource
    clips: int = 64
    frames: int = 12
    context: int = 2
    batch: int = 16

    def batches(self) -> Iterator[tuple[Clips, NDArray[np.int64]]]:
        """The clips in batches, with their first rows."""
        starts = self.source.spread(self.clips, self.frames)
        for first in range(0, len(starts), self.batch):
            chosen = starts[first : first + self.batch]
            yield self.source.at(chosen, self.frames), chosen
