"""Control-affine problems on the torus. `PROBLEMS` maps the names a file may hold to the classes it may build."""

from ocp_torch.problems.callable import Callable
from ocp_torch.problems.circle import Circle
from ocp_torch.problems.dataset import Dataset
from ocp_torch.problems.manufactured import Manufactured
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.torus import Torus

# `Callable` is not among them: a file may not name a function to be imported.
PROBLEMS = {"circle": Circle, "torus": Torus, "manufactured": Manufactured, "dataset": Dataset}

__all__ = ["PROBLEMS", "Callable", "Circle", "Dataset", "Manufactured", "Problem", "Torus"]
