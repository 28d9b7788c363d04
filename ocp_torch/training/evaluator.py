"""Certificates of a run's fields: quick ones on the way, by which fields are chosen, and the full one of those chosen."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import replace

from torch import nn

from ocp_torch.certificate import Certificate, CertificateSettings, Run, StageSettings, Trained, certify_fields
from ocp_torch.certificate.settings import Progress, silent
from ocp_torch.fields import Fields
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants
from ocp_torch.training.health import Evaluation
from ocp_torch.training.state import TrainState

# What a quick certificate costs: enough for a curve, not for a claim.
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
# The same with averages of `V`, where the full certificate tries them.
SEARCHED = replace(QUICK, mollify=None)


class Evaluator:
    """Of the averaged fields in ``state``; ``network`` makes networks for what is fitted, ``occupation`` says how the fields
    give `mu` (see `trained_policies`). ``seconds`` is how long the last quick certificate took, `None` before the first."""

    def __init__(
        self, problem: Problem, network: Callable[..., nn.Module], occupation: str | None, seed: int, state: TrainState
    ) -> None:
        self.problem, self.network, self.occupation, self.seed, self.state = problem, network, occupation, seed, state
        self.seconds: float | None = None
        self._latest: tuple[int, Constants, Certificate] | None = None  # and the step and constants it was made with

    @property
    def fields(self) -> Fields:
        """The averaged fields as they stand."""
        return self.state.average.module

    def certify(
        self,
        run: Run,
        settings: CertificateSettings,
        fields: Fields | None = None,
        tell: Progress = silent,
        problem: Problem | None = None,
    ) -> Certificate:
        """The certificate of ``fields``, or of the averaged ones; ``tell`` is given the name of each stage of it."""
        trained = Trained(fields or self.fields, self.occupation, self.network)
        return certify_fields(problem or self.problem, trained, self.state.constants, settings, run, tell)

    def quick(self, run: Run, settings: CertificateSettings, fields: Fields | None = None) -> Certificate:
        """The same on states that neither training nor `certify` uses: these certificates choose between fields, and on
        states of their own they cannot flatter the full certificate of their choice."""
        elsewhere = replace(run, seed=derive_seed(self.seed, Branch.VALIDATION))
        return self.certify(elsewhere, settings, fields, problem=self.problem.validation_view)

    def evaluate(self, run: Run) -> Certificate:
        """A quick certificate of the averaged fields; made anew only once they have changed."""
        now = (self.state.step, self.state.constants)
        if self._latest is None or self._latest[:2] != now:
            started = time.perf_counter()
            self._latest = (*now, self.quick(run, QUICK))
            self.seconds = time.perf_counter() - started
        return self._latest[2]

    def choose(self, run: Run) -> tuple[Fields, str | None]:
        """The fields to hand out: the averaged ones, or those of the best evaluation where they are clearly worse than that;
        and a sentence that says so."""
        best, step = self.state.health.best, self.state.step
        if best is None or best.step == step:
            return self.fields, None
        certificate = self.evaluate(run)
        if certificate.contradiction is not None:
            return self.fields, None  # fields from before the contradiction was seen would only hide it
        chosen, final = self.best_fields(), Evaluation.at(step, certificate)
        if best.better_than(final, sure=True) and SEARCHED.searches(self.state.constants):
            # Narrow spikes of the slack come and go from step to step, and averages of `V` do not see them.
            best = Evaluation.at(best.step, self.quick(run, SEARCHED, chosen))
            final = Evaluation.at(step, self.quick(run, SEARCHED))
        if not best.better_than(final, sure=True):
            return self.fields, None
        return chosen, (
            f"handed out are the averaged fields of step {best.step}: those of step {step} are worse "
            f"({final.in_words()} against {best.in_words()})."
        )

    def best_fields(self) -> Fields:
        """The averaged fields of the best evaluation so far."""
        fields = copy.deepcopy(self.fields)
        assert self.state.health.fields is not None  # kept with the best evaluation
        fields.load_state_dict(self.state.health.fields)
        return fields

    def forget(self) -> None:
        """The state was replaced: what was seen of another at the same step says nothing."""
        self._latest = None
