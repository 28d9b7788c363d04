"""What a certificate claims, held against the truth of a problem that was made to fool it; and fields to fool it with."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import torch

from ocp_torch.certificate import CertificateSettings, Run, StageSettings, Trained, certify_fields, certify_policy
from ocp_torch.certificate.contexts.controller import GIVEN
from ocp_torch.certificate.statistics.estimate import known
from ocp_torch.control.policies import NETWORK, zero_policy
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.problems.constants import resolve_constants
from support import zoo
from support.adversarial import gaussian
from support.formulas import Field

# Standard errors by which what counts may be off.
SIGMAS = 3.0
ROUNDING = 1e-7
# Bounds must be true whatever is spent: here few states, steps that are large, and nothing fitted.
BARE = CertificateSettings(
    points=512,
    replicates=8,
    trajectories=8,
    ascents=8,
    occupation_states=0,
    tolerance=5e-3,
    stage=StageSettings(steps=0),
)
CHEAP = replace(BARE, trajectories=16, occupation_states=16, mollify=False, tolerance=2e-3)
THOROUGH = CertificateSettings(
    points=8192,
    trajectories=64,
    ascents=32,
    occupation_states=48,
    tolerance=1e-3,
    stage=StageSettings(steps=60, rounds=1, batch=256),
)
NETWORKS = partial(PeriodicMLP, width=16, depth=2, modes=2)


def faults(certificate, problem) -> list[str]:
    """Everything that counts and lies on the wrong side of the truth."""
    low, high = problem.truth
    idle = problem.idle_between
    found = []

    def hold(name, claimed, truth, below):
        """``claimed``, made as mild as its errors allow, lies on the right side of ``truth``."""
        off = claimed - truth if below else truth - claimed
        if off > ROUNDING * max(abs(truth), abs(claimed)) + 1e-9:
            found.append(f"{name}: {claimed:.6g} is {'above' if below else 'below'} {truth:.6g}")

    mildest = lambda e, sign: e.value + sign * (SIGMAS * e.se + (e.bias or 0.0))
    for name, e in certificate.lower.items():
        if known(e) and certificate.counts(name):
            hold(f"lower {name}", mildest(e, -1.0), high, True)
    for name, e in certificate.upper.items():
        if known(e) and certificate.counts(name):
            hold(f"upper {name}", mildest(e, 1.0), low, False)
    if certificate.stands:
        for name, e in certificate.perf.items():
            if known(e):
                hold(f"perf {name}", mildest(e, 1.0), low, False)
        zero = certificate.baseline["zero"]
        if known(zero):
            hold("idle", mildest(zero, 1.0), idle[0], False)
            hold("idle", mildest(zero, -1.0), idle[1], True)
    for name, gap in certificate.gap.items():
        if name in ("certified", "simulated") and gap is not None and gap < -1e-12:
            found.append(f"gap {name}: {gap}")
    said = certificate.suboptimality
    if said["at_least"] is not None and said["at_most"] is not None and said["at_least"] > said["at_most"]:
        found.append(f"at least {said['at_least']} and at most {said['at_most']}")
    return found


def faults_of_idling(certificate, problem, name) -> list[str]:
    """Those, and what is claimed of a controller ``name`` that is known to do nothing."""
    found = faults(certificate, problem)
    if not certificate.stands:
        return found
    low, high = problem.truth
    least, most = problem.idle_between
    worse = (least / high - 1.0, most / low - 1.0) if low > 0.0 else (0.0, math.inf)
    e = certificate.perf.get(name)
    slack = lambda e: SIGMAS * e.se + (e.bias or 0.0) + ROUNDING * abs(e.value) + 1e-9
    if known(e) and not (e.value - slack(e) <= most and e.value + slack(e) >= least):
        found.append(f"perf of idling: {e.value:.6g} +- {slack(e):.2g}, but it is {least:.6g}")
    if certificate.controller not in (name, None):
        return found
    for of, b in certificate.upper.items():
        mine = certificate.about.get(of, name) == name and (b is None or b.controller in (None, name))
        if known(b) and certificate.counts(of) and mine and b.value + slack(b) < least:
            found.append(f"{of} of idling: {b.value:.6g} + {slack(b):.2g}, but it costs {least:.6g}")
    for of, b in certificate.perf_lower.items():
        if known(b) and b.value - slack(b) > most and not (of == "lagrangian" and not certificate.counts("lagrangian")):
            found.append(f"{of} of idling from below: {b.value:.6g} - {slack(b):.2g}, but it costs {most:.6g}")
    said, ends = certificate.suboptimality, certificate.gap
    errors = 3.0 * slack(e) / e.value if known(e) and e.value > 0.0 else 0.0
    if said["at_least"] is not None and said["at_least"] > worse[1] + errors + 1e-7:
        found.append(f"at least {said['at_least']:.4g} worse, but it is {worse}")
    if said["at_most"] is not None and said["at_most"] < worse[0] - errors - 1e-7:
        found.append(f"at most {said['at_most']:.4g} worse, but it is {worse}")
    for side in ("certified", "simulated"):
        if ends[side] is not None and ends[side] < worse[0] - errors - 1e-7:
            found.append(f"{side} gap {ends[side]:.4g}, but it is {worse[0]:.4g}")
    return found


def certified(problem, settings, seed=0, constants=None, occupation=None, **formulas):
    """The certificate of fields given by formulas or networks."""
    fields = Fields({n: f if isinstance(f, torch.nn.Module) else Field(f) for n, f in formulas.items()}).float()
    return certify_fields(
        problem,
        Trained(fields, occupation, NETWORKS),
        constants or resolve_constants(problem),
        settings,
        Run("x", "x", seed),
    )


def constant(level):
    return lambda x: torch.full_like(x[:, 0], level)


def values(problem, seed=0) -> dict:
    """Functions a training might end with, and some that it hardly would."""
    x = torch.rand(4096, problem.dim, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    f = problem.state_cost(x)
    unit = float(f.mean()) or 1.0
    noise = lambda size: zoo.rough_network(problem.dim, seed, size=size * unit)
    tiny, rough = noise(1e-3), noise(0.1)
    return {
        "sup f": constant(float(f.max())),
        "mean f": constant(unit),
        "above": constant(3.0 * float(f.max()) + 1.0),
        "truth": problem.formula,
        "truth and noise": lambda x: problem.formula(x) + tiny(x.double()).to(x),
        "truth and rough noise": lambda x: problem.formula(x) + rough(x.double()).to(x),
        "0.7 truth": lambda x: 0.7 * problem.formula(x),
        "1.3 truth": lambda x: 1.3 * problem.formula(x),
        "rough": rough,
        "network": NETWORKS(problem.dim, None),
    }


def densities(problem, seed=0) -> dict:
    """Pairs `w` and `log mu`."""
    m, d = problem.control_dim, problem.dim
    w, log_mu = zoo.rough_network(d, seed, m, size=0.1), zoo.rough_network(d, seed + 1, size=1.0)
    none = lambda x: 0.0 * x[:, :1].expand(-1, m)
    lump = lambda x: (1e-3 + gaussian(x, [0.3] * d, 0.03)).log()
    far = lambda x: -20.0 * (2.0 * math.pi * (x[:, 0] - 0.3)).sin().clamp_min(0.0) ** 4
    return {
        "uniform": (none, constant(0.0)),
        "little": (none, constant(-5.0)),
        "much": (none, constant(2.0)),
        "rough": (lambda x: w(x.double()).to(x), lambda x: log_mu(x.double()).to(x)),
        "lump": (none, lump),
        "nearly empty": (none, far),
    }


def certified_with_density(problem, name, settings, seed=0, value=None):
    w, log_mu = densities(problem, seed)[name]
    more = {} if value is None else {"value": values(problem, seed)[value]}
    return certified(problem, settings, seed, None, NETWORK, control_density=w, log_occupation=log_mu, **more)


def certified_idling(problem, settings, seed=0, value="truth"):
    """Of doing nothing, by the path of a given controller."""
    V = None if value is None else Field(values(problem, seed)[value]).double()
    policy = zero_policy(problem)
    return certify_policy(problem, policy, V, NETWORKS, resolve_constants(problem), settings, Run("x", "given", seed))


__all__ = ["CHEAP", "GIVEN", "THOROUGH", "replace"]
