"""The paper's kernel methods as contenders."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

from ocp_torch.certificate import Certificate, CertificateSettings, Run, Trained, certify_fields
from ocp_torch.control import policies
from ocp_torch.errors import InputError, require_integer, require_number
from ocp_torch.fields import PeriodicMLP
from ocp_torch.fields.sobolev import SobolevFeatures
from ocp_torch.files.limits import require_memory
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants
from ocp_torch.studies.benchmark.curve import Curve, Point, due
from ocp_torch.studies.benchmark.measure import Judge
from ocp_torch.studies.kernel import Iteration, step_sizes

OCCUPATION = {"dual": None, "primal": policies.CLOSED, "pd": policies.SADDLE}
# The paper's: constant for one player, 25 % less every 20,000 steps for two.
SCHEDULE = {"dual": "constant", "primal": "constant", "pd": "decay"}


@dataclass(frozen=True)
class KernelContender:
    """One of the paper's methods with truncated features, its step size ``step``, for ``seconds`` of CPU time.

    With ``seconds=None`` nothing but ``longest``, in steps, ends a run; a contest then gives it the time the others took.
    """

    method: str
    problem: Problem
    constants: Constants
    step: float
    seconds: float | None = None
    regularity: float = 2.0
    modes: int | None = None
    longest: int = 2_000_000

    def __post_init__(self) -> None:
        require_number(f"kernel.step.{self.method}", self.step, above=0.0)
        if self.seconds is not None:
            require_number("kernel.seconds", self.seconds, above=0.0)
        require_integer("kernel.longest", self.longest, 1)
        require_memory("kernel.longest", self.longest, 8)  # a step size each
        try:
            SobolevFeatures(self.problem.dim, self.regularity, modes=self.modes)
        except InputError as error:
            raise InputError(str(error).replace("model.", "kernel.")) from None

    @property
    def name(self) -> str:
        return f"kernel {self.method}"

    def in_time(self, seconds: float) -> KernelContender:
        """The same within ``seconds``, where none are given."""
        return self if self.seconds is not None else replace(self, seconds=seconds)

    def run(self, seed: int, judge: Judge, certificate: CertificateSettings | None) -> Curve:
        """Train, look at the bounds at growing counts outside the clock, and certify the end."""
        features = SobolevFeatures(self.problem.dim, self.regularity, modes=self.modes)
        iteration = Iteration(self.problem, self.method, self.constants, (seed,), features=features)
        sizes = step_sizes(self.step, self.longest, SCHEDULE[self.method])
        points, spent, most = [], 0.0, math.inf if self.seconds is None else self.seconds
        for count in due(500):
            stop = min(count, self.longest)
            while iteration.n < stop and spent < most:
                started = time.process_time()
                iteration.advance(sizes[iteration.n : min(iteration.n + 2000, stop)])
                spent += time.process_time() - started
            fields = iteration.fields(0)
            points.append(Point(iteration.samples, spent, judge(fields, OCCUPATION[self.method])))
            if spent >= most or iteration.n >= self.longest:
                break
        if certificate is None:
            return Curve(self.name, seed, points)
        started = time.process_time()
        certified = self.certify(fields, seed, iteration, certificate)
        return Curve(self.name, seed, points, certified.gap["certified"], time.process_time() - started)

    def certify(self, fields, seed: int, iteration: Iteration, settings: CertificateSettings) -> Certificate:
        """The full certificate, its policy evaluation with a network: a kernel method gets the same help as the others."""
        network = lambda **form: PeriodicMLP(modes=6, **form)
        trained = Trained(fields, OCCUPATION[self.method], network)
        run = Run(type(self.problem).__name__.lower(), self.method, seed, iteration.n, iteration.samples)
        return certify_fields(self.problem, trained, self.constants, settings, run)
