"""Bounds, performances and what they assume; needs no trainer."""

from ocp_torch.certificate.bounds import BOUNDS
from ocp_torch.certificate.bounds.bound import LOWER, PERFORMANCE, UPPER, Bound
from ocp_torch.certificate.certificate import Certificate
from ocp_torch.certificate.certify import certify_fields, certify_policy
from ocp_torch.certificate.contexts.fields import Trained, in_float64
from ocp_torch.certificate.contexts.trained import TrainedContext
from ocp_torch.certificate.report import table
from ocp_torch.certificate.settings import CertificateSettings, Run, StageSettings

__all__ = [
    "BOUNDS",
    "LOWER",
    "PERFORMANCE",
    "UPPER",
    "Bound",
    "Certificate",
    "CertificateSettings",
    "Run",
    "StageSettings",
    "Trained",
    "TrainedContext",
    "certify_fields",
    "certify_policy",
    "in_float64",
    "table",
]
