"""The loop: draw samples, step, average; look at the bounds, log and save on the way. It does not know its method."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import nn

from ocp_torch.certificate import (
    Certificate,
    CertificateSettings,
    Run,
    StageSettings,
    Trained,
    certify_fields,
)
from ocp_torch.certificate.progress import Progress, silent
from ocp_torch.errors import InputError
from ocp_torch.fields import Fields
from ocp_torch.fields.fields import typical_sizes
from ocp_torch.maths.sampling import derive_seed
from ocp_torch.objectives import Objective
from ocp_torch.problems import Problem
from ocp_torch.problems.blame import blamed
from ocp_torch.problems.constants import Constants
from ocp_torch.steppers import NonFiniteError, Stepper
from ocp_torch.training.batches import Batches
from ocp_torch.training.checkpoint import BEST, load_checkpoint, save_checkpoint
from ocp_torch.training.health import Evaluation, Health, sanity_warnings
from ocp_torch.training.settings import TrainerSettings
from ocp_torch.training.signals import Signals
from ocp_torch.training.state import gather, restore

# What a look at the bounds during training costs: enough for a curve, not for a claim.
QUICK = CertificateSettings(
    points=1024,
    replicates=4,
    trajectories=16,
    ascents=8,
    mollify=False,
    occupation_states=0,
    tolerance=5e-4,
    stage=StageSettings(steps=0),
)
SEARCHED = replace(QUICK, mollify=None)
# Looks choose between fields; on a branch of states of their own they cannot flatter the certificate of their choice.
LOOK_STREAM = 5
STEPS, TARGET_GAP, MAX_SECONDS = "steps", "target_gap", "max_seconds"
NOT_FINITE, FAILED = "not_finite", "failed"
# After a certificate that did not reach the target gap, the next is tried this much further on.
RETRY = 1.25


class Trainer:
    """Everything a run is made of. ``average`` is a `torch.optim.swa_utils.AveragedModel` of ``fields``; ``batches``
    draws samples; ``config`` is the configuration all this was built from, as plain data without nulls to fill."""

    def __init__(
        self,
        problem: Problem,
        fields: Fields,
        objective: Objective,
        constants: Constants,
        stepper: Stepper,
        average,
        batches: Batches,
        settings: TrainerSettings,
        network: Callable[..., nn.Module],
        seed: int,
        names: tuple[str, str],
        config: dict,
    ) -> None:
        self.problem, self.fields, self.objective, self.constants = problem, fields, objective, constants
        self.stepper, self.average, self.batches, self.settings = stepper, average, batches, settings
        self.network, self.seed, self.names, self.config = network, seed, names, config
        self.step, self.round, self.samples = 0, 0, 0
        self.seconds, self.elapsed = 0.0, 0.0  # in steps alone; with looks and checkpoints
        self.pending, self.retry = False, 0  # a certificate may have reached the target gap; not tried before this step
        self.stopped, self.ended = STEPS, False
        (mean, spread), _ = typical_sizes(problem)
        self.health = Health(unit=abs(mean) + spread)
        self.tell: Progress = silent  # who wants to know of the stages of a certificate
        self.look_seconds: float | None = None  # how long the last look took
        self._seen: tuple[int, Constants, Certificate] | None = None  # the last look, and what it was of

    @property
    def averaged_fields(self) -> Fields:
        """The fields that are handed out."""
        return self.average.module

    @property
    def run(self) -> Run:
        """Who and where this run is, for its certificate."""
        problem, method = self.names
        return Run(problem, method, self.seed, self.step, self.samples, self.seconds, self.stopped)

    @property
    def end(self) -> int:
        """The step at which the present round ends: round `k` (from 0) is `2^k` times as long as the first."""
        return self.settings.steps * (2 ** (self.round + 1) - 1)

    @property
    def progress(self) -> float:
        """The part of the present round that is done."""
        length = self.settings.steps * 2**self.round
        return 1.0 - (self.end - self.step) / length

    def fit(self, monitor, checkpoint: Path | None = None, signals: Signals | None = None) -> str:
        """Train until there is a reason to stop, and return it; save to ``checkpoint`` on the way and at the end.

        The reasons: `steps` (all rounds that `settings` allow), `max_seconds`, and `target_gap`, when a look is good enough
        that a certificate should decide: where it decides against, `go_on` and call again. A signal that ``signals`` caught
        raises `Preempted` after the step in hand, with the state saved. Raises `NonFiniteError` before an update that is
        not finite.
        """
        self.ended = False
        while self._reason() is None:
            if self.step < self.end:
                self._advance(monitor, checkpoint)
            elif self._wants_another_round():
                self.round += 1
                monitor.extended(self)
            else:
                break
            if signals is not None and signals.received is not None:
                self.save(checkpoint)
                signals.take()
        self.stopped, self.ended = self._reason() or STEPS, True
        self.save(checkpoint)
        return self.stopped

    @property
    def why_stopped(self) -> str:
        """The reason for which `fit` stopped, in words."""
        settings, at = self.settings, f"step {self.step:,}"
        if self.stopped == MAX_SECONDS:
            return f"trainer.max_seconds = {settings.max_seconds:g} are over, at {at} of {self.end:,}"
        if self.stopped == TARGET_GAP:
            return f"a look at {at} finds trainer.target_gap = {settings.target_gap:g} reached"
        more = self.round + 1 < settings.rounds
        return f"all {self.step:,} steps are done" + (
            f", and trainer.good_gap = {settings.good_gap:g} is met" if more else ""
        )

    def go_on(self) -> None:
        """The certificate did not reach the target gap: train on, and try again later."""
        self.pending, self.retry = False, round(RETRY * self.step)

    def _reason(self) -> str | None:
        limit = self.settings.max_seconds
        if self.pending:
            return TARGET_GAP
        return MAX_SECONDS if limit is not None and self.elapsed >= limit else None

    def _advance(self, monitor, checkpoint: Path | None) -> None:
        """One step, and what is due after it."""
        settings = self.settings
        started = time.perf_counter()
        self.objective.progress = self.progress
        report = self.stepper.step(self.batches.draw, lambda: self.average.update_parameters(self.fields))
        self.step += 1
        self.samples += report.samples
        stepped = time.perf_counter()
        self.seconds += stepped - started
        due = lambda every: every > 0 and self.step % every == 0
        last = self.step == self.end
        if due(settings.log_every) or last:
            for sentence in self.health.stepped(self.step, report.losses, self.stepper.parameters):
                monitor.noticed(sentence)
        monitor.stepped(self, report, log=due(settings.log_every) or last)
        if due(settings.evaluate_every) and not last:
            self._look(monitor, checkpoint)
        self.elapsed += time.perf_counter() - started
        if due(settings.checkpoint_every) or self.pending:
            self.save(checkpoint)

    def _look(self, monitor, checkpoint: Path | None) -> None:
        """Look at the bounds; keep the state if they are the best so far, and see whether they are good enough."""
        self._require_finite()
        certificate = self.look()
        monitor.evaluated(self, certificate)
        best = self.health.looked(Evaluation.at(self.step, certificate), self.averaged_fields, certificate)
        if certificate.contradiction is not None:
            for sentence in self.health.contradicted(self.step, certificate.contradiction):
                monitor.noticed(sentence)
        if 2 * self.step >= self.settings.steps and not self.health.warned:
            for sentence in sanity_warnings(self.problem, self.constants, certificate, self.seed):
                self.health.warned = True
                monitor.noticed(f"step {self.step}: {sentence}")
        target, gap = self.settings.target_gap, certificate.plain_gap
        self.pending = target is not None and gap is not None and gap <= target and self.step >= self.retry
        if best and checkpoint is not None:
            save_checkpoint(checkpoint.with_name(BEST), self.state_dict())

    def save(self, checkpoint: Path | None) -> None:
        """Write the state to ``checkpoint``, never one that is not finite. Raises `NonFiniteError`, `StorageError`."""
        self._require_finite()
        if checkpoint is not None:
            save_checkpoint(checkpoint, self.state_dict(), self.settings.keep)

    def _require_finite(self) -> None:
        for name, parameter in self.fields.named_parameters():
            if not torch.isfinite(parameter).all():
                raise NonFiniteError(
                    f"the weights of {name} are not finite; try a smaller optimizer.lr, or stepper.clip."
                )

    def _wants_another_round(self) -> bool:
        """Whether rounds are left and the gap is not good yet; never without a lower bound to measure it by."""
        if self.round + 1 >= self.settings.rounds or self.fields.value is None or not self.problem.has_simulator:
            return False  # without a simulation there is no gap to go by
        gap = self.look().plain_gap
        return gap is None or gap > self.settings.good_gap

    def use(self, constants: Constants) -> None:
        """Train and certify with ``constants`` from now on."""
        self.constants = self.objective.constants = constants

    def look(self) -> Certificate:
        """A quick certificate of the averaged fields, on states that neither training nor `certify` uses."""
        if self._seen is None or self._seen[:2] != (self.step, self.constants):
            started = time.perf_counter()
            self._seen = (self.step, self.constants, self._quick(QUICK))
            self.look_seconds = time.perf_counter() - started
        return self._seen[2]

    def _quick(self, settings: CertificateSettings, fields: Fields | None = None) -> Certificate:
        run = replace(self.run, seed=derive_seed(self.seed, LOOK_STREAM))
        return self.certify(settings, fields, run=run, problem=self.problem.validation_view)

    def certify(
        self,
        settings: CertificateSettings,
        fields: Fields | None = None,
        run: Run | None = None,
        problem: Problem | None = None,
    ) -> Certificate:
        """The certificate of ``fields``, or of the averaged ones as they stand."""
        trained = Trained(fields or self.averaged_fields, self.objective.occupation, self.network)
        tell = self.tell if run is None else silent  # looks are too many to be told of
        return certify_fields(problem or self.problem, trained, self.constants, settings, run or self.run, tell)

    def choose(self) -> tuple[Fields, str | None]:
        """The fields to hand out: the averaged ones, or those of the best look where they are clearly worse than that; and
        a sentence that says so."""
        best = self.health.best
        if best is None or best.step == self.step:
            return self.averaged_fields, None
        seen = self.look()
        if seen.contradiction is not None:
            return self.averaged_fields, None  # an earlier look would but hide it
        fields, final = self.best_fields(), Evaluation.at(self.step, seen)
        if best.better_than(final, sure=True) and SEARCHED.searches(self.constants):
            # Spikes of the slack come and go from look to look; the certificate's averages of V know nothing of them.
            best = Evaluation.at(best.step, self._quick(SEARCHED, fields))
            final = Evaluation.at(self.step, self._quick(SEARCHED))
        if not best.better_than(final, sure=True):
            return self.averaged_fields, None
        return fields, (
            f"handed out are the averaged fields of step {best.step}: those of step {self.step} are worse "
            f"({_words(final)} against {_words(best)})."
        )

    def best_fields(self) -> Fields:
        """The averaged fields of the best look."""
        fields = copy.deepcopy(self.averaged_fields)
        fields.load_state_dict(self.health.fields)
        return fields

    def state_dict(self) -> dict:
        """Everything needed to go on exactly."""
        return gather(self)

    def load_state_dict(self, state: dict) -> None:
        """The way back from `state_dict`; see `restore` for what other `trainer.steps` mean."""
        self._seen = None
        restore(self, state)

    def resume(self, checkpoint: Path, state: dict | None = None) -> None:
        """Go on from ``checkpoint`` exactly where it was saved; ``state`` is what it holds, where that has been read already.

        Raises `InputError` when it is damaged or does not fit.
        """
        try:
            state = load_checkpoint(checkpoint) if state is None else state
            self.load_state_dict(state)
            self._rehearse()
            self.load_state_dict(state)
        except Exception as error:  # a crafted state raises whatever its odd part leads to
            if isinstance(error, InputError):
                raise
            if (told := blamed(error, type(self.problem))) is not None:
                raise told from None
            reason = next(iter(str(error).splitlines()), "empty").rstrip(".")
            raise InputError(f"{checkpoint} does not fit this run ({type(error).__name__}: {reason}).") from None

    def _rehearse(self) -> None:
        """One step for nothing: shows whether an optimiser can work with the state it was given."""
        self.objective.progress = 1.0
        try:
            self.stepper.step(self.batches.draw, lambda: self.average.update_parameters(self.fields))
        except NonFiniteError:
            pass  # the run itself will say so


def _words(look: Evaluation) -> str:
    return (
        f"a gap of {100 * look.gap:.3g} %"
        if look.gap is not None
        else f"a performance of {look.perf or float('nan'):.6g}"
    )
