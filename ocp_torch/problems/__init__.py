"""Control-affine problems on the torus. `PROBLEMS` maps the names a file may hold to the classes it may build."""

from ocp_torch.problems.arm import Arm
from ocp_torch.problems.callable import Callable
from ocp_torch.problems.circle import Circle
from ocp_torch.problems.dataset import Dataset
from ocp_torch.problems.dubins import Dubins
from ocp_torch.problems.kuramoto import Kuramoto
from ocp_torch.problems.manufactured import Manufactured
from ocp_torch.problems.pendulum import Pendulum
from ocp_torch.problems.phase_neurons import PhaseNeurons
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.robot import RobotArm
from ocp_torch.problems.torus import Torus
from ocp_torch.problems.unicycle import Unicycle

# `Callable` is not among them: a file may not name a function to be imported.
PROBLEMS = {
    "circle": Circle,
    "torus": Torus,
    "manufactured": Manufactured,
    "dataset": Dataset,
    "kuramoto": Kuramoto,
    "phase_neurons": PhaseNeurons,
    "arm": Arm,
    "unicycle": Unicycle,
    "dubins": Dubins,
    "pendulum": Pendulum,
    "robot": RobotArm,
}

__all__ = ["Callable", "Problem", "PROBLEMS", *sorted(cls.__name__ for cls in PROBLEMS.values())]
