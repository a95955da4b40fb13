"""The training loop: questions of when, and what is done then."""

from __future__ import annotations

import logging
import math
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from envs.errors import UsageError
from worldmodel.ahead import Ahead
from worldmodel.checkpoint import load_training, save_model, save_training
from worldmodel.clips import Clips, ClipSource
from worldmodel.colour_jitter import ColourJitter
from worldmodel.devices import find_precision
from worldmodel.held_out import ValidationSet
from worldmodel.inference import InferenceNetwork, inference_network
from worldmodel.journal import Journal, finite
from worldmodel.objective import StepInputs, objective
from worldmodel.options import TrainOptions
from worldmodel.pictures import picture_prediction
from worldmodel.ranks import ALONE, Ranks
from worldmodel.recording import Recorder
from worldmodel.stopping import stop_signals
from worldmodel.validation import Scores, summary, validate
from worldmodel.world_model import WorldModel

logger = logging.getLogger(__name__)
MAX_BAD_STEPS = 10


class Diverged(UsageError):
    """Training has come to numbers that are none."""


class Trainer:
    """Trains one model; exact resume from its run's folder.

    Args:
        model: on its device.
        options: of the run; `options.out` holds everything that is written.
        train: clips to learn from.
        validation: clips to score on.
        origin: what `save_model` keeps about where the model came from.
        ranks: the processes that train together. The first alone validates and writes; any number of them goes through
            the same clips and random draws.

    Raises:
        UsageError: the ranks cannot share the batch.
    """

    def __init__(
        self,
        model: WorldModel,
        options: TrainOptions,
        train: ClipSource,
        validation: ValidationSet,
        origin: dict[str, Any],
        ranks: Ranks = ALONE,
    ) -> None:
        self.model, self.options, self.train_clips, self.validation = model, options, train, validation
        self.origin, self.ranks, self.share = origin, ranks, ranks.share(options.batch)
        self.device = model.device
        model.precision = getattr(torch, find_precision(options.precision, self.device))
        self.modules: dict[str, torch.nn.Module] = {"model": model}
        self.inference: InferenceNetwork | None = None
        if model.latent_channels:
            self.inference = inference_network(model).to(self.device)
            self.modules["inference"] = self.inference
        parameters = [p for module in self.modules.values() for p in module.parameters()]
        self.parameters = parameters
        self.optimiser = torch.optim.Adam(parameters, lr=options.learning_rate, fused=self.device.type == "cuda")
        self._draw_ahead: Callable[[int], tuple[Clips, ColourJitter | None]] = self._draw
        if self.device.type == "cuda" or not train.in_memory:
            self._draw_ahead = Ahead(self._draw, options.steps)
        self._compute: Callable[[StepInputs], dict[str, Tensor]] = self.differentiate
        if self.device.type == "cuda" and options.cuda_graphs:
            self._compute = Recorder(self.differentiate, parameters)
        self.step, self.best, self.seconds = 0, -math.inf, 0.0
        self.bad_steps = 0

    def run(self, told: Callable[[Scores], None] = lambda scores: None) -> None:
        """Train to the last step, resuming where the run's folder stands; SIGTERM and Ctrl-C save and stop.

        Args:
            told: is called with the scores after each validation.
        """
        options = self.options
        state = load_training(options.out, self.modules, self.optimiser)
        if state is not None:
            self.step, self.best, self.seconds = state["step"], state["best"], state["seconds"]
            self._check_data(state.get("data"))
        self.ranks.begin_alike(self.parameters, self.step)
        first = self.ranks.first
        started = time.monotonic()
        base_seconds = self.seconds
        waited = 0.0
        terms: dict[str, float] = {}
        with ExitStack() as opened:  # however it ends, what the journal still holds is written
            journal = opened.enter_context(closing(Journal(options.out, self.step))) if first else None
            bar = tqdm(
                total=options.steps, initial=self.step, desc="train", unit="step", dynamic_ncols=True, disable=not first
            )
            opened.enter_context(bar)
            if journal and self.step == 0 and options.start_from is not None:
                bar.write(f"{options.start_from}: {summary(self.score(journal))}")
            stops = opened.enter_context(stop_signals())
            while self.step < options.steps:
                self.model.train()
                asked = time.monotonic()
                clips = self.next_clips()
                waited += time.monotonic() - asked
                terms = self.update(clips)
                self.step += 1
                self.seconds = base_seconds + time.monotonic() - started
                bar.update()
                bar.set_postfix({k: f"{v:.4f}" for k, v in terms.items() if k in ("loss", "rgb", "depth", "knn")})
                last = self.step == options.steps
                stop = self.ranks.any(bool(stops))
                if journal and (self.step % options.log_every == 0 or last):
                    share = waited / max(time.monotonic() - started, 1e-9)
                    journal.write("train", self.step, terms | {"seconds": self.seconds, "data_wait": share})
                if journal and (self.step % options.validate_every == 0 or last):
                    scores = self.score(journal)
                    bar.write(f"step {self.step}: {summary(scores)}")
                    told(scores)
                if journal and (self.step % options.save_every == 0 or last or stop):
                    self.save()
                if stop:
                    if journal:
                        bar.write(f"stopped at step {self.step}; the same command goes on from here")
                    break
        if signal.SIGINT in stops:
            raise KeyboardInterrupt
        if self.step < options.steps:
            raise SystemExit(128 + signal.SIGTERM)  # the usual exit code of who was asked to stop

    def update(self, clips: Clips) -> dict[str, float]:
        """One step of Adam on a batch of clips; returns the terms of the loss.

        A loss or gradient that is not finite skips the step; several in a row end the run.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate
        terms = self._numbers(self._compute(self.inputs(clips)))
        bad = [name for name, value in terms.items() if not math.isfinite(value)]
        if bad:
            self._skip(f"loss (terms: {', '.join(bad)})")
            return terms
        self.ranks.average_gradients(self.parameters)
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, self.options.clip_gradient)
        if torch.isfinite(norm):
            self.optimiser.step()
            self.bad_steps = 0
        else:
            self._skip("gradient")
        return terms

    def _skip(self, what: str) -> None:
        """Leave the weights alone for a step.

        Raises:
            Diverged: for too many steps in a row.
        """
        self.bad_steps += 1
        logger.warning("step %d skipped: %s not finite", self.step, what)
        if self.bad_steps >= MAX_BAD_STEPS:
            raise Diverged(
                f"not finite {MAX_BAD_STEPS} steps in a row: {what}; look for bad frames with inspect-dataset, or "
                "lower --learning-rate"
            )

    def differentiate(self, inputs: StepInputs) -> dict[str, Tensor]:
        """Set the gradients of this rank's objective anew; returns the loss and its unweighted terms."""
        self.optimiser.zero_grad(set_to_none=True)
        total, terms = objective(self.model, self.inference, inputs, self.options)
        total.backward()
        return {name: value.detach() for name, value in {"loss": total, **terms}.items()}

    def _numbers(self, terms: dict[str, Tensor]) -> dict[str, float]:
        """Terms as numbers, the means over all ranks: every term is a mean over equally many pixels of each clip."""
        values = self.ranks.mean(torch.stack(list(terms.values()))).tolist()
        return dict(zip(terms, values, strict=True))

    def inputs(self, clips: Clips) -> StepInputs:
        """This rank's clips with all that this step draws and where it stands in the schedule."""
        schedule, device = self.options.schedule, self.device
        draw = torch.Generator().manual_seed(_mix(self.options.seed, self.step))
        clip_count, steps = len(clips.rgb) * self.ranks.count, clips.actions.shape[1]
        noise = None
        if self.inference is not None:
            each = 1 if self.model.config.latents == "clip" else steps
            noise = self._my(torch.randn((clip_count, each, *self.model.latent_shape), generator=draw))
        coins = self._my(torch.rand((clip_count, steps), generator=draw))
        truth = 1 - _ramp(self.progress, 0.0, schedule.truth_until)
        return StepInputs(
            rgb=clips.rgb,
            depth=clips.depth,
            actions=clips.actions,
            noise=noise,
            coins=coins,
            truth=torch.tensor(truth, device=device),
            kl_weight=torch.tensor(self.options.losses.kl * _ramp(self.progress, *schedule.kl_ramp), device=device),
            inferred=self.inference is not None and self.progress >= schedule.posterior_from,
            taught=truth > 0,
        )

    @property
    def progress(self) -> float:
        """Fraction of the run that is done."""
        return self.step / self.options.steps

    @property
    def learning_rate(self) -> float:
        """Warm-up, then a cosine."""
        schedule = self.options.schedule
        rise = _ramp((self.step + 1) / self.options.steps, 0.0, schedule.warmup)
        fall = 0.5 * (1 + math.cos(math.pi * _ramp(self.progress, schedule.warmup, 1.0)))
        return self.options.learning_rate * rise * (schedule.final_rate + (1 - schedule.final_rate) * fall)

    def next_clips(self) -> Clips:
        """This rank's clips of this step."""
        clips, jitter = self._draw_ahead(self.step)
        clips = clips.to(self.device)
        return clips if jitter is None else jitter.apply(clips)

    def _draw(self, step: int) -> tuple[Clips, ColourJitter | None]:
        """This rank's clips of a step as they are stored, and what becomes of their colours; by seed and step alone."""
        options = self.options
        rng = np.random.default_rng((options.seed, step))
        frames = options.schedule.clip_length(step / options.steps)
        clips = self.train_clips.sample(rng, options.batch, frames, self.share)
        clips = clips.pinned() if self.device.type == "cuda" else clips
        if options.colour_jitter <= 0:
            return clips, None
        return clips, ColourJitter.draw(options.batch, options.colour_jitter, rng).share(self.share)

    def _my(self, draws: Tensor) -> Tensor:
        """This rank's share of random draws for the clips of all ranks, on its device."""
        each = len(draws) // self.ranks.count
        return draws[self.ranks.index * each :][:each].to(self.device)

    def score(self, journal: Journal) -> Scores:
        """Validate, draw a picture, and keep the model if it is the best so far."""
        scores = validate(self.model, self.validation)
        journal.write("validation", self.step, scores)
        clips, starts = next(self.validation.batches())
        source, truth = self.validation.source, None
        if source.dataset.has_ground_truth:
            truth = source.truth_at(starts[:1], self.validation.frames)
        picture = self.options.out / "pictures" / f"step-{self.step:08d}.png"
        picture_prediction(self.model, clips, truth, self.options.context, source.frame_seconds, picture)
        score = float(scores["score"])  # type: ignore[arg-type]
        if score >= self.best:
            self.best = score
            origin = self.origin | {"step": self.step, "seconds": round(self.seconds), "validation": finite(scores)}
            save_model(self.model, self.options.out / "model", origin, self.inference)
        return scores

    def save(self) -> None:
        """Write a checkpoint to go on from."""
        state = {"step": self.step, "best": self.best, "seconds": self.seconds, "data": self.origin.get("data")}
        save_training(self.options.out, self.modules, self.optimiser, state)

    def _check_data(self, before: dict[str, str] | None) -> None:
        """Refuse to go on with other data: clips, held-out episodes and the scale of the actions would change."""
        now = self.origin.get("data")
        if before is not None and before != now:  # checkpoints of old do not say
            changed = ", ".join(name for name in before if now is None or before[name] != now.get(name))
            raise UsageError(
                f"the data has changed since step {self.step} of {self.options.out} ({changed}); restore it, or give "
                "another --out"
            )


def _ramp(x: float, low: float, high: float) -> float:
    """0 until low, 1 from high, linear between."""
    return min(max((x - low) / max(high - low, 1e-9), 0.0), 1.0)


def _mix(seed: int, step: int) -> int:
    return int(np.random.SeedSequence((seed, step, 1)).generate_state(1, np.uint64)[0]) >> 1
