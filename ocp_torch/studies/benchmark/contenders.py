"""Contenders: the paper's kernel methods; the package's trained fields, any method with any model as `scripts/train.py` would
train it; and SAC and PPO of Stable-Baselines3, which need the optional extra `rl`."""

import copy
import math
import time
from dataclasses import dataclass

import numpy as np
import torch

from ocp_torch.certificate import CertificateSettings, Run, Trained, certify_fields
from ocp_torch.control import policies
from ocp_torch.errors import InputError, require_integer, require_number
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.fields.sobolev import SobolevFeatures
from ocp_torch.files.limits import require_memory
from ocp_torch.gym.environment import ControlEnvironment, observe
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants
from ocp_torch.runs.build import build_certificate_settings, build_trainer
from ocp_torch.studies.benchmark.measure import Curve, Judge, Point, due
from ocp_torch.studies.kernel.iterations import Iteration, step_sizes
from ocp_torch.training.monitor import Observer

OCCUPATION = {"dual": None, "primal": policies.CLOSED, "pd": policies.SADDLE}
# The paper's schedules: constant for one player, 25 % less every 20,000 steps for two.
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

    def run(self, seed: int, judge: Judge, settings: CertificateSettings) -> Curve:
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
        started = time.process_time()
        # A network for policy evaluation in the certificate, so that a kernel method gets the same help as the others.
        trained = Trained(fields, OCCUPATION[self.method], lambda **form: PeriodicMLP(modes=6, **form))
        run = Run(type(self.problem).__name__.lower(), self.method, seed, iteration.n, iteration.samples)
        certified = certify_fields(self.problem, trained, self.constants, settings, run)
        return Curve(self.name, seed, points, certified.gap["certified"], time.process_time() - started)


class Recorder(Observer):
    """Keeps the averaged fields at growing sample counts, with the CPU seconds of training until then."""

    def __init__(self) -> None:
        self.due = due(10_000)
        self.next = next(self.due)
        self.kept: list[tuple[int, float, Fields]] = []
        self.started = time.process_time()

    def stepped(self, trainer, report, log: bool) -> None:
        if trainer.samples >= self.next or trainer.step == trainer.end:
            self._keep(trainer)

    def refined(self, trainer, helped: bool | None) -> None:
        if helped:
            self._keep(trainer)

    def _keep(self, trainer) -> None:
        now = time.process_time()
        self.kept.append((trainer.samples, now - self.started, copy.deepcopy(trainer.averaged_fields)))
        while self.next <= trainer.samples:
            self.next = next(self.due)
        self.started += time.process_time() - now


@dataclass(frozen=True)
class NetworkContender:
    """A trained run of the package; ``config`` is its resolved training configuration, with method and model."""

    config: dict

    @property
    def name(self) -> str:
        return f"{self.config['model']['name']} {self.config['method']['name']}"

    def run(self, seed: int, judge: Judge, settings: CertificateSettings) -> Curve:
        """Train with the default budget; the certificate at the end is the configuration's."""
        trainer = build_trainer({**self.config, "seed": seed})
        recorder = Recorder()
        trainer.fit(recorder)
        judge = Judge(trainer.problem, trainer.constants)
        occupation = trainer.objective.occupation
        points = [Point(samples, seconds, judge(fields, occupation)) for samples, seconds, fields in recorder.kept]
        started = time.process_time()
        certified = trainer.certify(build_certificate_settings(trainer.config))
        return Curve(self.name, seed, points, certified.gap["certified"], time.process_time() - started)


def require_rl() -> tuple:
    """The modules `gymnasium` and `stable_baselines3`, or an `InputError` that says how to get them."""
    try:
        import gymnasium
        import stable_baselines3
    except ImportError as error:
        raise InputError(
            f'SAC and PPO need packages that are not installed ({error.name}); get them with pip install -e ".[rl]".'
        ) from None
    return gymnasium, stable_baselines3


@dataclass(frozen=True)
class RLContender:
    """SAC or PPO by ``name``, with the library's defaults; actions reach ``control_bound``, which all methods may know."""

    name: str
    problem: Problem
    control_bound: float
    steps: int
    time_step: float
    horizon: float

    def __post_init__(self) -> None:
        require_integer(f"rl.steps.{self.name}", self.steps, 1)

    def run(self, seed: int, judge: Judge, settings: CertificateSettings) -> Curve:
        """Learn for ``steps`` transitions; the policy is simulated in continuous time like every other controller."""
        _, sb3 = require_rl()
        environment = ControlEnvironment(self.problem, self.control_bound, self.time_step, self.horizon, seed)
        discount = math.exp(-self.problem.discount * self.time_step)
        made = {"sac": sb3.SAC, "ppo": sb3.PPO}[self.name]
        model = made("MlpPolicy", environment, gamma=discount, seed=seed, device="cpu", verbose=0)

        def policy(x: torch.Tensor) -> torch.Tensor:
            actions, _ = model.predict(np.atleast_2d(observe(x)), deterministic=True)
            u = torch.from_numpy(environment.control_bound * np.asarray(actions)).to(x)
            return self.problem.control_cost.within(u, torch.ones_like(x[:, 0]))

        points, spent = [], 0.0
        for count in due(500):
            started = time.process_time()
            model.learn(min(count, self.steps) - model.num_timesteps, reset_num_timesteps=False)
            spent += time.process_time() - started
            perf = judge.performance(policy)
            points.append(Point(model.num_timesteps, spent, {"policy": perf}))
            if model.num_timesteps >= self.steps:
                break
        return Curve(self.name, seed, points)
