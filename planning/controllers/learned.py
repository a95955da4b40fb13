"""What controllers with a world model share: what the model is shown, and how planned moves become its actions."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from data_collection.actions import aggregate_actions
from envs.camera import CameraModel
from envs.errors import UsageError
from planning.controllers.base import Goal, Observation, PlanningController
from planning.effectors import Arm, Effector
from planning.icem import ICEM
from planning.observations import taken_in
from worldmodel.interface import TOLERANCE, camera_mismatch
from worldmodel.models import KINDS


class LearnedController(PlanningController):
    """Plans with a world model, which is shown frames and actions, nothing else.

    Of the world a controller of this kind is given RGB-D frames, proprioception (for where the end-effector is now, and
    the gripper's command), the camera's geometry and the goal. A subclass says in `imagine` what it makes of the
    model's predictions.

    Args:
        model: a world model (`worldmodel.load_model`) with `observe`, `step` and `frame_gap`.
        camera: geometry of the camera that takes the frames; but for its pose, the one that the model was trained with.
        planner: searches sequences of moves, each held for `frame_gap` control steps.
        context_frames: frames that the model is shown before every plan.
        effector: what is moved; the arm of the tabletop when None.
        options: follower, reach; see `PlanningController`.

    Raises:
        UsageError: the model is of another kind, was trained with another camera, takes other actions than the
            effector's, or is to be shown no frame; in an episode: an observation is not what `taken_in` asks for.

    Attributes:
        kinds: of models that it can plan with; all, unless a subclass says otherwise.
        frames: the last frames that the model is shown, the newest last.
        designated: for each of them the pixels (M,) that show the body of the designated point, counted row by row.
    """

    kinds: tuple[str, ...] = tuple(KINDS)

    def __init__(
        self,
        model: Any,
        camera: CameraModel,
        planner: ICEM,
        context_frames: int = 2,
        effector: Effector | None = None,
        **options: Any,
    ) -> None:
        if context_frames < 1:
            raise UsageError(f"context_frames is {context_frames}; show the model 1 frame or more")
        if model.kind not in self.kinds:
            raise UsageError(
                f"the model is a {model.kind}, but {type(self).__name__} plans with {' or '.join(self.kinds)};"
                " give a model of that kind"
            )
        difference = camera_mismatch(camera, model.camera)
        if difference is not None:
            raise UsageError(
                f"the camera has {difference}, which the {model.kind} was trained on; give a model of this camera, or"
                " an environment with the model's"
            )
        effector = effector or Arm()
        difference = _other_actions(effector, model)
        if difference is not None:
            raise UsageError(
                f"the {model.kind} learned from actions {difference}; give the effector of its robot, a"
                " planning.effectors.Effector: effector=..."
            )
        super().__init__(planner, model.frame_gap, effector, **options)
        self.model, self.camera = model, camera
        self.context_frames = context_frames
        parameter = next(iter(model.parameters()), None)
        self.device = torch.device("cpu") if parameter is None else parameter.device

    def reset(self, observation: Observation, goal: Goal) -> None:
        super().reset(taken_in(observation, self.camera), goal)
        self.frames: deque[Observation] = deque(maxlen=self.context_frames)
        self.designated: deque[torch.Tensor] = deque(maxlen=self.context_frames)
        self.executed: deque[NDArray] = deque(maxlen=self.context_frames - 1)

    def act(self, observation: Observation) -> NDArray[np.float32]:
        return super().act(taken_in(observation, self.camera))

    def decide(self, observation: Observation) -> NDArray:
        self.watch(observation)
        move = super().decide(observation)
        self.executed.append(self.aggregated(move))
        return move

    def watch(self, observation: Observation) -> None:
        """Take in a frame that the model is to be shown."""
        pixels = self.follower.pixels(observation, self.camera)
        if not self.frames:  # nothing came before: the first frame, standing still
            before = self.context_frames - 1
            self.frames.extend([observation] * before)
            self.designated.extend([pixels] * before)
            self.executed.extend([self.aggregated(np.zeros(self.effector.axes))] * before)
        self.frames.append(observation)
        self.designated.append(pixels)

    def aggregated(self, moves: NDArray) -> NDArray[np.float32]:
        """The actions (..., action_dim) of the model for moves (..., axes), each held for a frame gap."""
        return self.held(self.effector.action(moves))

    def held(self, actions: NDArray) -> NDArray[np.float32]:
        """The actions (..., action_dim) of the model for those of the environment, each held for a frame gap."""
        repeated = np.repeat(actions[..., None, :], self.hold, axis=-2)
        return aggregate_actions(repeated, self.model.context.action_aggregation, self.model.context.action_scale)

    def observed(self) -> Any:
        """The model's state after the frames so far."""
        rgb = self.tensor(np.stack([frame["rgb"] for frame in self.frames])) / 255
        depth = self.tensor(np.stack([frame["depth"] for frame in self.frames]))
        actions = np.reshape(np.array(self.executed, np.float32), (-1, self.model.action_dim))
        with torch.inference_mode():
            return self.model.observe(rgb.permute(0, 3, 1, 2)[None], depth[None, :, None], self.tensor(actions)[None])

    def seen_points(self, observation: Observation) -> torch.Tensor:
        """What the camera sees, (3, H, W), metres, camera frame."""
        return self.tensor(self.camera.unproject(observation["depth"])).permute(2, 0, 1)

    def in_camera(self, points: NDArray) -> torch.Tensor:
        """Points (..., 3) of the world in the camera frame, metres."""
        return self.tensor(self.camera.to_camera(points))

    def tensor(self, array: NDArray) -> torch.Tensor:
        """Float32, where the model is."""
        return torch.as_tensor(np.asarray(array, np.float32), device=self.device)


def _other_actions(effector: Effector, model: Any) -> str | None:
    """In what the actions that a model learned from are not the effector's, if in anything."""
    name, context = type(effector).__name__, model.context
    if model.action_dim != effector.action_dim:
        return f"of {model.action_dim} numbers, those of the {name} have {effector.action_dim}"
    if effector.aggregation is not None and tuple(effector.aggregation) != tuple(context.action_aggregation):
        return f"that add up as {tuple(context.action_aggregation)}, those of the {name} as {effector.aggregation}"
    if effector.scale is not None and not np.allclose(effector.scale, context.action_scale, rtol=TOLERANCE):
        return f"in units of {tuple(context.action_scale)}, those of the {name} are in {effector.scale}"
    return None
