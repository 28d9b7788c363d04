"""Recordings of problems, and the certificate that comes from one."""

from __future__ import annotations

from ocp_torch.certificate import CertificateSettings, Run, StageSettings, Trained, certify_fields
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.runs import record as recording
from support.formulas import Exactly


def record(folder, problem, count=1500, name="data.npz", **fields):
    """Samples of ``problem`` in a file, by the code behind scripts/record.py."""
    out = folder / name
    return recording.record(problem, count, out, **{"seed": 0, "divergences": True, "contrast": 0.0, **fields})


def certificate_of(data, problem, seed, value=None, steps=0):
    value = value or Exactly(problem.exact_value)
    fields = Fields({"value": value}).double()
    settings_ = CertificateSettings(stage=StageSettings(steps=steps, rounds=1, batch=64))
    network = lambda **form: PeriodicMLP(width=16, depth=2, modes=2, **form)
    constants = resolve_constants(data, occupation_bound=problem.occupation_bound)
    return certify_fields(data, Trained(fields, None, network), constants, settings_, Run("dataset", "dual", seed))
