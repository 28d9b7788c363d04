"""The loop: draw, step, average; evaluate, log and save on the way. It does not know its method."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from torch import nn

from ocp_torch.certificate import Certificate, CertificateSettings, Run, Trained, certify_fields
from ocp_torch.certificate.settings import Progress, silent
from ocp_torch.compute.cuda_graphs import replays_on
from ocp_torch.compute.processes import LostError, SingleProcess
from ocp_torch.errors import InputError
from ocp_torch.fields import Fields
from ocp_torch.objectives import Objective, Phase
from ocp_torch.problems import Problem
from ocp_torch.problems.blame import blamed
from ocp_torch.problems.constants import Constants
from ocp_torch.training.checkpoint import BEST, load_checkpoint, misfit, save_checkpoint
from ocp_torch.training.evaluator import Evaluator
from ocp_torch.training.health import sanity_warnings
from ocp_torch.training.observer import Observer
from ocp_torch.training.refinement import refine
from ocp_torch.training.settings import TrainerSettings
from ocp_torch.training.slack_waves import seek_waves
from ocp_torch.training.state import TrainState
from ocp_torch.training.stopping import ASKED, STEPS, Signals, in_words, late, reason_to_stop
from ocp_torch.training.whole_step import whole_step


@dataclass(eq=False)
class Trainer:
    """A run of ``objective`` on ``problem``. What changes while it goes on is in ``state``."""

    problem: Problem
    objective: Objective
    settings: TrainerSettings
    network: Callable[..., nn.Module]  # makes networks for what its certificates fit
    seed: int
    state: TrainState
    tell: Progress = silent  # is given the name of each stage of the full certificate
    stopped: str = STEPS  # why
    asked: bool = False  # to stop after the step in hand
    ranks: SingleProcess = field(default_factory=SingleProcess)  # the processes of this run

    def __post_init__(self) -> None:
        state = self.state
        self.fields, self.stepper, self.batches = state.fields, state.stepper, state.batches
        self.health, self.names, self.config = state.health, state.names, state.config
        self.trained = Trained(state.average.module, self.objective.occupation, self.network)
        if self.settings.graphs:
            self.stepper.replay = self.batches.replay = replays_on(self.settings.torch_device)
        self.evaluator = Evaluator(self.problem, self.trained, state)

    @property
    def step(self) -> int:
        return self.state.step

    @property
    def fresh(self) -> bool:
        """Whether nothing has been done yet."""
        return self.step == 0 and (self.state.warm is None or self.state.warm.round == 0)

    @property
    def samples(self) -> int:
        return self.state.samples

    @property
    def constants(self) -> Constants:
        return self.state.constants

    @property
    def averaged_fields(self) -> Fields:
        """The fields that are handed out."""
        return self.trained.fields

    @property
    def run(self) -> Run:
        """The names, seed and progress of this run, for its certificate."""
        return Run(*self.names, self.seed, self.step, self.samples, self.state.seconds, self.stopped)

    @property
    def end(self) -> int:
        """The number of steps after which the present round is over."""
        return self.settings.end(self.state.round)

    @property
    def phase(self) -> Phase:
        """The `Phase` of the next step."""
        k = self.state.round
        return Phase(self.constants, self.settings.part_done(self.step, k), self.batches.ranks.size, later=k > 0)

    def fit(self, monitor: Observer, checkpoint: Path | None = None, signals: Signals | None = None) -> str:
        """Train until there is a reason to stop, and return it; save to ``checkpoint`` on the way and at the end.

        The reasons: `steps` (all rounds that `settings` allow), `solved` (see `refine`), `max_seconds`, `callback` (it was
        ``asked`` to), and `target_gap`: a quick evaluation is good enough for a full one to decide. Where the full one is
        not, `postpone` the end and call this again. A signal that ``signals`` caught raises `Preempted` after the step in
        hand, with the state saved. Raises `NonFiniteError` before an update that is not finite.

        Of several processes each calls this; the first saves, and makes warm starts and quick evaluations while the others
        wait. Raises `LostError`, with the state saved after the last whole step, where one of them ends without a word.
        """
        signals = signals or Signals()
        self.state.ended = False
        self.ranks.use(self.settings.torch_device, self.problem)
        self.stepper.ranks = self.batches.ranks = self.ranks
        try:
            self.stopped = self._until_stopped(monitor, checkpoint, signals)
        except LostError as error:
            signals.ending = True
            self.save(checkpoint)
            raise LostError(f"{str(error).rstrip('.')}, at step {self.step}.") from None
        self.state.ended = self.stopped != ASKED  # a resume then goes on
        self.save(checkpoint)
        return self.stopped

    def _until_stopped(self, monitor: Observer, checkpoint: Path | None, signals: Signals) -> str:
        """Train until there is a reason to stop, on which all processes agree."""
        self.ranks.from_first(lambda: self._warm_up(monitor, checkpoint, signals))
        for module in (self.fields, self.state.average):
            module.load_state_dict(self.ranks.from_first(module.state_dict))
        reason = self.ranks.from_first(self._reason)
        while reason is None:
            if not self.state.refined and self.step in (self.settings.newton_after or self.end, self.end):
                self._refine(monitor, checkpoint, signals)
            elif self.step < self.end:
                self._advance(monitor, checkpoint)
            elif self.ranks.from_first(self._wants_another_round):
                self.state.round += 1
                monitor.extended(self)
            else:
                return STEPS
            asked, over, *came = self.ranks.agree([self.asked, late(self.settings, self.state), *signals.came()])
            if any(came):
                self.ranks.from_first(lambda: self.save(checkpoint))
                signals.raise_first(came)
            reason = ASKED if asked else reason_to_stop(self.settings, self.state, over)
        return reason

    @property
    def why_stopped(self) -> str:
        """The reason for which `fit` stopped, in words."""
        return in_words(self.stopped, self.settings, self.state, good=self._another_may_follow)

    def _reason(self) -> str | None:
        return ASKED if self.asked else reason_to_stop(self.settings, self.state, late(self.settings, self.state))

    def _warm_up(self, monitor: Observer, checkpoint: Path | None, signals: Signals) -> None:
        """Make the rounds left of the warm start; `V` then learns its best one, which itself stays a candidate."""
        state, warm = self.state, self.state.warm
        while warm is not None and not warm.done and self._reason() is None:
            started = time.perf_counter()
            looked = warm.advance()
            if looked:
                warm.hand_over([self.fields, self.averaged_fields])
            state.samples += warm.drawn
            state.seconds += (spent := time.perf_counter() - started)
            state.elapsed += spent
            monitor.warmed(self, looked)
            if looked or signals.received is not None:
                self.save(checkpoint)
            signals.take()

    def _advance(self, monitor: Observer, checkpoint: Path | None) -> None:
        """Make a step, and what is due after it."""
        settings, state, started = self.settings, self.state, time.perf_counter()
        seek_waves(self.problem, state, self.step - settings.start(state.round), self.ranks)
        report = whole_step(self.state, self.phase, self.ranks)
        state.step, state.refined = state.step + 1, False
        state.samples += self.ranks.size * report.samples
        state.seconds += time.perf_counter() - started
        last = state.step == self.end
        if log := self._due(settings.log_every) or last:
            for sentence in self.health.stepped(state.step, report.losses, self.stepper.parameters):
                monitor.noticed(sentence)
        monitor.stepped(self, report, log)
        if self._due(settings.evaluate_every) and not last:
            state.pending = self.ranks.from_first(lambda: self.evaluate(monitor, checkpoint))
        state.elapsed += time.perf_counter() - started
        if self._due(settings.checkpoint_every) or state.pending:
            self.save(checkpoint)

    def _refine(self, monitor: Observer, checkpoint: Path | None, signals: Signals) -> None:
        """Try Gauss-Newton steps, and evaluate what they give where an evaluation is due before the next round."""
        state, settings = self.state, self.settings
        monitor.refined(self, None)
        stop = lambda: self.asked or signals.received is not None
        helped = refine(self.evaluator, settings, self.run, self.ranks, stop)
        between = self.step == self.end and state.round + 1 < settings.rounds
        if state.refined and between and self._due(settings.evaluate_every):
            state.pending = self.ranks.from_first(lambda: self.evaluate(monitor, checkpoint))
        monitor.refined(self, helped)

    def _due(self, every: int) -> bool:
        return every > 0 and self.step % every == 0

    def evaluate(self, monitor: Observer, checkpoint: Path | None) -> bool:
        """A quick evaluation: keep the state if it is the best so far, and see whether it may be good enough to end."""
        self.state.require_finite()
        certificate = self.evaluator.evaluate(self.run)
        monitor.evaluated(self, certificate)
        best = self.health.evaluated(self.evaluator.evaluation(certificate), self.averaged_fields, certificate)
        # Early on, what is not learnt yet says nothing.
        tell = 2 * self.step >= self.settings.steps and not self.health.warned
        found = sanity_warnings(self.problem, self.constants, certificate, self.seed) if tell else []
        for sentence in self.health.doubts(self.step, certificate.contradiction, found):
            monitor.noticed(sentence)
        target, gap = self.settings.target_gap, certificate.plain_gap
        self.state.pending = target is not None and gap is not None and gap <= target and self.step >= self.state.retry
        if best and checkpoint is not None:
            save_checkpoint(checkpoint.with_name(BEST), self.state.state_dict())
        return self.state.pending

    @property
    def _another_may_follow(self) -> bool:
        """Whether rounds are left; never without both bounds to measure the gap by."""
        measured = self.fields.value is not None and self.problem.has_simulator
        return measured and self.state.round + 1 < self.settings.rounds

    def _wants_another_round(self) -> bool:
        """Whether rounds are left and the gap is not good yet."""
        return self._another_may_follow and not self.evaluator.reaches(self.settings.good_gap, self.run)

    def certify(self, settings: CertificateSettings, fields: Fields | None = None) -> Certificate:
        """The full certificate of ``fields``, or of the averaged ones as they stand."""
        trained = replace(self.trained, fields=fields or self.averaged_fields)
        return certify_fields(self.problem, trained, self.constants, settings, self.run, self.tell)

    def save(self, checkpoint: Path | None) -> None:
        """Write the state to ``checkpoint``, never one that is not finite. Raises `NonFiniteError`, `StorageError`."""
        self.state.require_finite()
        if checkpoint is not None:
            save_checkpoint(checkpoint, self.state.state_dict(), self.settings.keep)

    def resume(self, checkpoint: Path, state: dict | None = None) -> None:
        """Go on from ``checkpoint`` exactly where it was saved; ``state`` is what it holds, where that has been read already.

        Raises `InputError` when it is damaged or does not fit.
        """
        try:
            state = load_checkpoint(checkpoint) if state is None else state
            self.state.load_state_dict(state, self.settings)
            self.state.try_step(replace(self.phase, progress=1.0))
            self.state.load_state_dict(state, self.settings)
            self.evaluator.latest = None  # what was seen of another state at the same step says nothing
        except InputError:
            raise
        except Exception as error:  # a crafted state raises whatever its odd part leads to
            raise blamed(error, type(self.problem)) or misfit(checkpoint, error) from None
