"""Control-affine problems on the torus. `PROBLEMS` maps the names a file may hold to the classes it may build."""

from ocp_torch.problems.arm import Arm
from ocp_torch.problems.circle import Circle
from ocp_torch.problems.manufactured import Manufactured
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.torus import Torus

PROBLEMS = {"circle": Circle, "torus": Torus, "manufactured": Manufactured, "arm": Arm}

__all__ = ["PROBLEMS", "Arm", "Circle", "Manufactured", "Problem", "Torus"]
