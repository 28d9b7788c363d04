"""Bounds, performances and what they assume; needs no trainer."""

from ocp_torch.certificate.certificate import Certificate, Run
from ocp_torch.certificate.certify import Trained, certify_fields, in_float64
from ocp_torch.certificate.external.external import certify_policy
from ocp_torch.certificate.report import table
from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.upper.policy_evaluation import StageSettings

__all__ = [
    "Certificate",
    "CertificateSettings",
    "Run",
    "StageSettings",
    "Trained",
    "certify_fields",
    "certify_policy",
    "in_float64",
    "table",
]
