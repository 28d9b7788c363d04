"""Quick certificates of a run's fields on the way, by which those that are handed out are chosen."""

import copy
import time
from dataclasses import dataclass, replace

from ocp_torch.certificate import (
    Certificate,
    CertificateSettings,
    Run,
    StageSettings,
    Trained,
    TrainedContext,
    certify_fields,
)
from ocp_torch.certificate.lower.tightened import batches_of
from ocp_torch.certificate.settings import Progress
from ocp_torch.certificate.upper.policy_evaluation import STEEP_FACTOR
from ocp_torch.fields import SUBSOLUTION, Fields
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants
from ocp_torch.training.health import Evaluation
from ocp_torch.training.state import TrainState


class QuickSettings(CertificateSettings):
    """Settings of a certificate that makes no claim: without audits, which took 9 of the 15 s that simulated an arm, nor
    searches in steep places, which took half of a unicycle's and three quarters of a torus' quick evaluations."""

    audited = False
    # Of ten quick evaluations of five trained V one took as many and none more; where a discount of .05 makes the loop of an
    # untrained V stiff, one with up to four was not done after four minutes.
    doublings = 2


# The effort of a quick evaluation: enough for a curve, not for a claim.
QUICK = QuickSettings(
    points=1024,
    replicates=4,
    trajectories=16,
    ascents=8,
    mollify=False,
    occupation_states=0,
    tolerance=5e-4,
    stage=StageSettings(steps=0),
)
# Seconds of a full certificate without its fits, relative to a quick one: some 7, 11 and 13 of a circle, a unicycle, a torus.
FULL_OVER_QUICK = 10.0
# A step takes as long as for so many states more than it has: a unicycle's took 24 ms for 2,048 states and 10 ms for 512.
# Without them a batch of 32 in training had told 49 minutes for a certificate of two and a half.
STEP_STATES = 600


@dataclass(eq=False)
class Evaluator:
    """Makes quick evaluations of a run on ``problem`` as it goes on."""

    problem: Problem
    trained: Trained  # the averaged fields in ``state``
    state: TrainState
    seconds: float | None = None  # how long the last one took
    latest: tuple[int, Constants, Certificate] | None = None  # with the step and constants it was made with

    def quick(self, run: Run, settings: CertificateSettings) -> Certificate:
        """A certificate on states that neither training nor the full certificate uses, so that a choice of fields by it does
        not flatter the full certificate of the chosen ones."""
        elsewhere = replace(run, seed=derive_seed(run.seed, Branch.VALIDATION))
        return certify_fields(self.problem.validation_view, self.trained, self.state.constants, settings, elsewhere)

    def evaluate(self, run: Run) -> Certificate:
        """The certificate on few samples of the averaged fields; made anew only once they have changed."""
        now = (self.state.step, self.state.constants)
        if self.latest is None or self.latest[:2] != now:
            started = time.perf_counter()
            self.latest = (*now, self.quick(run, QUICK))
            self.seconds = time.perf_counter() - started
        return self.latest[2]

    def evaluation(self, certificate: Certificate) -> Evaluation:
        """How good the fields are by their ``certificate``, made at the present step. Where there is no `M` the performance
        alone counts: spikes of the slack come and go, and the full certificate trains `V` on for its bound."""
        return Evaluation.at(self.state.step, certificate, by_gap=not self.state.constants.needs_no_M)

    def expected(self, settings: CertificateSettings) -> float | None:
        """About how many seconds a full certificate by ``settings`` takes; `None` where there was no quick one yet."""
        if self.seconds is None:
            return None
        state, stage = self.state, settings.stage
        states = float(stage.steps * (stage.batch + STEP_STATES))
        if settings.searches(state.constants) and self.trained.fields.value is not None and self.problem.has_simulator:
            longest = STEEP_FACTOR * 2 ** (stage.rounds - 1)  # as beside kinks
            steps, batch = batches_of(self.problem, settings.points, settings.bound_steps)
            states = states * longest + steps * (batch + STEP_STATES)
        trained = state.samples + state.step * STEP_STATES
        return FULL_OVER_QUICK * self.seconds + states * state.seconds / max(trained, 1)

    def reaches(self, gap: float, run: Run) -> bool:
        """Whether a quick evaluation finds the averaged fields within ``gap``."""
        found = self.evaluate(run).plain_gap
        return found is not None and found <= gap

    def choose(self, run: Run) -> tuple[Fields, str | None]:
        """The fields to hand out: the averaged ones, or those of the best evaluation where they are clearly worse than that;
        and a sentence that says so."""
        best, step = self.state.health.best, self.state.step
        if best is None or best.step == step:
            return self.trained.fields, None
        certificate = self.evaluate(run)
        if certificate.contradiction is not None:
            return self.trained.fields, None  # fields from before the contradiction was seen would only hide it
        final = self.evaluation(certificate)
        if not best.better_than(final, sure=True):
            return self.trained.fields, None
        return self.best_fields(), (
            f"handed out are the averaged fields of step {best.step}: those of step {step} are worse "
            f"({final.in_words()} against {best.in_words()})."
        )

    def tightened(self, fields: Fields, run: Run, settings: CertificateSettings, tell: Progress) -> Fields:
        """``fields`` with `V` trained on for its bound beside them, where that pays (`TrainedContext.tightened`)."""
        if not self.problem.has_simulator:
            return fields
        how = self.problem, self.state.constants, settings, run, tell
        W = TrainedContext(*how, trained=replace(self.trained, fields=fields)).tightened
        return fields if W is None else Fields({**fields.networks, SUBSOLUTION: W.to(next(fields.parameters()))})

    def best_fields(self) -> Fields:
        """The averaged fields of the best evaluation so far."""
        fields = copy.deepcopy(self.trained.fields)
        assert self.state.health.fields is not None  # kept with the best evaluation
        fields.load_state_dict(self.state.health.fields)
        return fields
