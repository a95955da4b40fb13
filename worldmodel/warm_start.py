"""Training that starts from the weights of another model: a shipped one, or that of an earlier run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from envs.errors import UsageError
from worldmodel.checkpoint import content_hashes, data_seen, load_inference, load_model, load_origin
from worldmodel.config import ModelContext
from worldmodel.inference import InferenceNetwork
from worldmodel.models import ModelName, name_of
from worldmodel.options import TrainOptions
from worldmodel.world_model import WorldModel


@dataclass(frozen=True)
class WarmStart:
    """The model that a run starts from."""

    name: str
    """As it was given: see `find_model`."""
    model: WorldModel

    @classmethod
    def load(cls, name: str) -> WarmStart:
        """Load it.

        Raises:
            UsageError: there is no such model, or it is damaged.
        """
        return cls(name, load_model(name, precision="float32"))

    @property
    def model_name(self) -> ModelName:
        """What `--model` is for it."""
        return name_of(self.model.kind, self.model.config)

    def options(self, options: TrainOptions) -> TrainOptions:
        """Options with what its weights fix: kind, architecture, and what it takes for frames and actions."""
        return replace(
            options,
            start_from=self.name,
            model=self.model_name,
            architecture=self.model.config,
            frame_gap=self.model.context.frame_gap,
            action_column=self.model.context.action_column,  # type: ignore[arg-type]
        )

    def context(self, context: ModelContext) -> ModelContext:
        """A run's context with its statistics of actions, in the units of the run's data.

        So the same motion is the same number to the network as before, however things move in the new data. A model
        that sees no actions takes any data's.

        Raises:
            UsageError: the data has actions of another kind, or in no unit.
        """
        before = self.model.context
        if not self.model.config.act_cond:
            return context
        if before.action_aggregation != context.action_aggregation:
            raise UsageError(
                f"the data's actions add up by {context.action_aggregation} over a frame gap, those of {self.name} by "
                f"{before.action_aggregation}; train without --start-from"
            )
        if not all(context.action_scale):
            raise UsageError(
                f"the data's action_scale is {context.action_scale}, and what a unit of 0 means cannot be told; give "
                "the metres or radians of each, or train without --start-from"
            )
        units = [old / new for old, new in zip(before.action_scale, context.action_scale, strict=True)]
        return replace(
            context,
            action_mean=tuple(mean * unit for mean, unit in zip(before.action_mean, units, strict=True)),
            action_std=tuple(std * unit for std, unit in zip(before.action_std, units, strict=True)),
        )

    def give_weights(self, model: WorldModel, inference: InferenceNetwork | None) -> None:
        """Copy its weights, and those of its inference network if it has one.

        Raises:
            UsageError: the other model is not of its kind, architecture and size of pictures.
        """
        if found := _differences(_nature(self.model), _nature(model)):
            raise UsageError(f"{self.name} has {found}; leave that to --start-from, or train without it")
        model.load_state_dict(self.model.state_dict())
        if inference is not None and (own := load_inference(self.name, self.model)) is not None:
            inference.load_state_dict(own.state_dict())

    def note(self, data: Mapping[str, str]) -> dict[str, Any]:
        """What a run keeps about where it started.

        Args:
            data: content hashes of what the run trains and validates on.

        Raises:
            UsageError: it was trained on what the run validates on.
        """
        origin = load_origin(self.name)
        before = origin.get("data", {})
        if data["validation"] in data_seen(self.name, "train") and before != data:  # else the same part was held out
            raise UsageError(f"{self.name} was trained on the validation set; give another --validation")
        kept: dict[str, Any] = {key: origin[key] for key in ("step", "data", "start") if key in origin}
        return {"name": self.name, "files": content_hashes(self.name), **kept}


def _nature(model: WorldModel) -> dict[str, Any]:
    """All that decides which weights a model has, and what they mean."""
    size = (model.camera.height, model.camera.width)
    return {"model": name_of(model.kind, model.config), **asdict(model.config), "picture height and width": size}


def _differences(before: dict[str, Any], now: dict[str, Any]) -> str:
    return "; ".join(f"{name} = {old}, not {now[name]}" for name, old in before.items() if old != now[name])
