"""Controllers for control-affine problems on the torus, with a certificate of how far from optimal they can be."""

from typing import TYPE_CHECKING

from ocp_torch.control.controller import Controller
from ocp_torch.control.saved import load_controller
from ocp_torch.errors import InputError
from ocp_torch.problems import PROBLEMS, Circle, Dataset, Manufactured, Problem, Simulator, Torus
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.control_limit import BoxLimitedCost, LimitedCost
from ocp_torch.problems.physical.coordinates import Angle, Interval
from ocp_torch.problems.physical.start import Points
from ocp_torch.problems.physical.system import System
from ocp_torch.runs.external import certify

if TYPE_CHECKING:
    from ocp_torch.cli.python import compare, reference, train

__version__ = "0.1.0"
__all__ = [
    "PROBLEMS",
    "Angle",
    "BoxLimitedCost",
    "Simulator",
    "Circle",
    "Controller",
    "Dataset",
    "InputError",
    "Interval",
    "LimitedCost",
    "Manufactured",
    "Points",
    "PowerCost",
    "Problem",
    "System",
    "Torus",
    "certify",
    "compare",
    "load_controller",
    "reference",
    "train",
]


if not TYPE_CHECKING:

    def __getattr__(name):
        # Imported once they are asked for: they bring the command line with them.
        if name not in ("compare", "reference", "train"):
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from ocp_torch.cli import python

        return getattr(python, name)

    def __dir__():
        return sorted({*globals(), *__all__})
