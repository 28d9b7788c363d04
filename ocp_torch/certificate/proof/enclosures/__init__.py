"""What a problem's data and a control cost can be over a cell, as Taylor models: one file for each class that is known.

To prove bounds for a class of your own, either give it a method ``enclosure(box)`` that returns an `Enclosure`, or
register a function for it as the files here do. A problem that states its `lipschitz` constants needs neither.
"""

from ocp_torch.certificate.proof.enclosures import costs, lipschitz, manufactured, torus  # noqa: F401  (they register)
from ocp_torch.certificate.proof.enclosures.enclosure import Enclosure, conjugate_model, enclosure
from ocp_torch.certificate.proof.enclosures.spot_check import contradiction

__all__ = ["Enclosure", "conjugate_model", "contradiction", "enclosure"]
