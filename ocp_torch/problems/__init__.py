"""Control-affine problems on the torus. `PROBLEMS` maps the names a file may hold to the classes it may build."""

from ocp_torch.problems.exact.circle import Circle
from ocp_torch.problems.exact.manufactured import Manufactured
from ocp_torch.problems.exact.torus import Torus
from ocp_torch.problems.lipschitz import Lipschitz
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.recorded.dataset import Dataset
from ocp_torch.problems.simulator.simulator import Simulator
from ocp_torch.problems.systems.arm import Arm
from ocp_torch.problems.systems.cart_pole import CartPole
from ocp_torch.problems.systems.double_integrator import DoubleIntegrator
from ocp_torch.problems.systems.double_pendulum import Acrobot, Pendubot
from ocp_torch.problems.systems.dubins import Dubins
from ocp_torch.problems.systems.inverted_double_pendulum import InvertedDoublePendulum
from ocp_torch.problems.systems.kuramoto import Kuramoto
from ocp_torch.problems.systems.mountain_car import MountainCar
from ocp_torch.problems.systems.pendulum import Pendulum
from ocp_torch.problems.systems.phase_locked_loop import PhaseLockedLoop
from ocp_torch.problems.systems.phase_neurons import PhaseNeurons
from ocp_torch.problems.systems.quadrotor import Quadrotor
from ocp_torch.problems.systems.robot import RobotArm
from ocp_torch.problems.systems.satellite import Satellite
from ocp_torch.problems.systems.unicycle import Unicycle

# Without `Simulator`: a file may not name a function to be imported.
PROBLEMS: dict[str, type[Problem]] = {
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
    "cart_pole": CartPole,
    "double_integrator": DoubleIntegrator,
    "phase_locked_loop": PhaseLockedLoop,
    "acrobot": Acrobot,
    "pendubot": Pendubot,
    "quadrotor": Quadrotor,
    "satellite": Satellite,
    "mountain_car": MountainCar,
    "inverted_double_pendulum": InvertedDoublePendulum,
}

__all__ = ["Lipschitz", "Problem", "Simulator", "PROBLEMS", *sorted(cls.__name__ for cls in PROBLEMS.values())]
