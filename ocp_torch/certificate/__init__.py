"""Bounds, performances and what they assume; needs no trainer."""

from ocp_torch.certificate.certificate import Certificate, Run, table
from ocp_torch.certificate.certify import CertificateSettings, certify_fields

__all__ = ["Certificate", "CertificateSettings", "Run", "certify_fields", "table"]
