r"""Running estimates of the bracket while a run trains: cheap, for curves that show where it is going, and no claim.

On states that training never draws, with the averaged fields: `F_M`, for the best constant where no `M` is known; `J` of the
density players; and `Perf` of the controller, by a few short paths with `V` as control variate.
"""

import math
import time
from functools import cached_property
from typing import cast

import torch
from torch import Tensor

from ocp_torch.certificate import Trained
from ocp_torch.certificate.simulated.loops import loop_of
from ocp_torch.control.policies import admissible_density, occupation_density, trained_policies
from ocp_torch.maths.brownian import Grid, discounted, increments, path_integral
from ocp_torch.maths.quantiles import upper_quantile
from ocp_torch.maths.runge_kutta import discounted_integral
from ocp_torch.maths.seeds import Branch, derive_seed, generators_kept
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.problems.starts import evaluation_distribution, initial_points

LOWER_STATES = 1024  # for the bound from below
UPPER_STATES = 256  # for the bound from above, which takes divergences
PATHS = 32
PATH_STEPS = 24
HORIZON = 4.0  # of paths, in units of 1 / rho: what is left weighs 2 %, and with `V` it is 2 % of a slack
FREE_SECONDS = 0.5  # that every run has for estimates: ten points of most problems
TIME_PART = 0.02  # of a run's time that it has for estimates beyond these


class RunningEstimates:
    """Estimates of ``trained`` fields on ``problem``, always on the same states and the same noise."""

    def __init__(self, problem: Problem, trained: Trained, seed: int) -> None:
        self.problem, self.trained, self.seed = problem, trained, derive_seed(seed, Branch.RUNNING)
        self._spent = 0.0

    def due(self, elapsed: float) -> bool:
        """Whether a run that has taken ``elapsed`` seconds has time for estimates; never with recorded samples, which are for
        training alone."""
        return self.problem.has_simulator and self._spent <= FREE_SECONDS + TIME_PART * elapsed

    def __call__(self, constants: Constants) -> dict[str, float]:
        """Estimates by name, in the order of the bracket. The process's random generators stay as they were, as it depends on
        the clock whether estimates are made."""
        started = time.perf_counter()
        with torch.no_grad(), generators_kept():
            found = self._estimates(constants)
        self._spent += time.perf_counter() - started
        return {name: value for name, value in found.items() if math.isfinite(value)}

    def _estimates(self, constants: Constants) -> dict[str, float]:
        fields = self.trained.fields
        found: dict[str, float] = {}
        mean = 0.0
        if fields.value is not None:
            generator = Generator.of(self.problem, self._wide)
            V = generator.jet(fields.value)
            slack, mean = generator.hjb_slack(V), float(self._wide.mean(V.value * self._wide.mu0))
            level = upper_quantile(slack, self._wide.weight, 1.0 / constants.M) if constants.needs_no_M else 0.0
            above = float(self._wide.mean((slack - level).clamp_min(0.0)))
            found["F_M"] = mean - level - constants.M * above
        if self.problem.exact_optimum is not None:
            found["OPT"] = self.problem.exact_optimum
        found["Perf"] = mean + self._simulated(constants)
        if fields.control_density is not None and self.problem.gives_divergences:
            found["J"] = self._penalised(constants)
        return found

    def _penalised(self, constants: Constants) -> float:
        """`J(w, mu)`."""
        form = self.trained.occupation, self.problem, self.trained.fields, constants
        generator, density = Generator.of(self.problem, self._few), occupation_density(*form)
        w, mu, residual = generator.liouville_residual(admissible_density(*form), density, self.problem.still)
        return float(self._few.mean(generator.primal_integrand(w, mu, residual, constants.C_V)))

    def _simulated(self, constants: Constants) -> float:
        """The simulated cost of the controller less `E[V mu0]`, or the whole cost where there is no `V`."""
        problem, fields, rho = self.problem, self.trained.fields, self.problem.discount
        policy = next(iter(trained_policies(self.trained.occupation, problem, fields, constants).values()))
        dynamics = loop_of(problem, policy, fields.value)
        (x0, mass), horizon = self._starts, HORIZON / rho
        if problem.noisy:
            grid, sigma = Grid(torch.full_like(mass, horizon), PATH_STEPS, 1.0), cast(Tensor, problem.noise(x0[:1]))
            moves = increments(grid, sigma.shape[-1], 0, self.seed, 0)
            integral, _ = path_integral(dynamics, problem.noise, x0, grid, moves, discounted(rho))
        else:
            rates, _ = discounted_integral(dynamics, dynamics.start(x0), rho, horizon, PATH_STEPS, wrap=False)
            integral = rates if fields.value is None else rates[:, 0]
        whole = 1.0 if fields.value is not None else -1.0 / math.expm1(-HORIZON)
        return whole * float((mass * integral).mean())

    def _samples(self, count: int, replicate: int, divergences: bool) -> Samples:
        x, weight = evaluation_distribution(self.problem).draw(count, replicate, self.seed)
        return Samples.of(self.problem, x, divergences=divergences, weight=weight).to(self._like)

    @property
    def _like(self) -> Tensor:
        return next(self.trained.fields.parameters())

    @cached_property
    def _wide(self) -> Samples:
        return self._samples(LOWER_STATES, 0, False)

    @cached_property
    def _few(self) -> Samples:
        return self._samples(UPPER_STATES, 1, True)

    @cached_property
    def _starts(self) -> tuple[Tensor, Tensor]:
        x, mass = initial_points(self.problem, PATHS, 3, self.seed)
        return x.to(self._like), mass.to(self._like)
