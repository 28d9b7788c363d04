"""An arm from a URDF: the same kinematics as the planar arm's, as the library's own, and plain refusals."""

import numpy as np
import pytest
import torch
from PIL import Image

from ocp_torch.errors import InputError
from ocp_torch.problems import Arm, RobotArm
from ocp_torch.problems.systems.linkage import Linkage
from ocp_torch.runs.metrics.classical import classical_policy
from ocp_torch.runs.metrics.trial import metrics
from ocp_torch.runs.pictures.picture import motion

IDENTITY = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]


def shifted(x: float, axis: list[float]) -> list[float]:
    """A row of a chain: `x` metres along the link before, turning about ``axis``."""
    return [*IDENTITY[:3], x, *IDENTITY[4:], *axis]


PLANAR = [
    shifted(0.0, [0, 0, 1.0]),
    shifted(0.5, [0, 0, 1.0]),
    shifted(0.3, [0, 0, 1.0]),
    shifted(0.2, [0.0, 0.0, 0.0]),
]

URDF_TEXT = """<robot name="three">
  <link name="base"/> <link name="a"/> <link name="b"/> <link name="c"/> <link name="tip"/> <link name="slide"/>
  <joint name="j1" type="revolute"> <parent link="base"/> <child link="a"/> <axis xyz="0 0 1"/>
    <origin xyz="0 0 0.3" rpy="0.1 0 0"/> <limit lower="-1" upper="1" effort="1" velocity="1"/> </joint>
  <joint name="j2" type="continuous"> <parent link="a"/> <child link="b"/> <axis xyz="0 2 0"/>
    <origin xyz="0.1 0 0.2" rpy="0 0.4 0.7"/> </joint>
  <joint name="stiff" type="fixed"> <parent link="b"/> <child link="c"/> <origin xyz="0.2 0.1 0" rpy="0 0 1.0"/> </joint>
  <joint name="j3" type="revolute"> <parent link="c"/> <child link="tip"/> <axis xyz="1 0 0"/>
    <origin xyz="0 0.25 0" rpy="0 0 0"/> <limit lower="-1" upper="1" effort="1" velocity="1"/> </joint>
  <joint name="rail" type="prismatic"> <parent link="tip"/> <child link="slide"/> <axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/> </joint>
</robot>"""

ELBOW_AMONG_BALLS = dict(obstacles=[[0.3, -0.2, 0.5, 0.1]])


@pytest.fixture
def urdf(tmp_path):
    pytest.importorskip("yourdfpy", reason="the extra urdf is not installed")
    path = tmp_path / "three.urdf"
    path.write_text(URDF_TEXT)
    return path


def states(dim: int, count: int = 200) -> torch.Tensor:
    return torch.rand(count, dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_a_chain_in_a_plane_is_the_planar_arm():
    flat = Arm(dim=3, lengths=[0.5, 0.3, 0.2], target=[0.2, 0.4], obstacles=[])
    robot = RobotArm(chain=PLANAR, target=[0.2, 0.4, 0.0])
    x = states(3)
    torch.testing.assert_close(robot.end_effector(x)[:, :2], flat.end_effector(x))
    torch.testing.assert_close(robot.state_cost(x), flat.state_cost(x))
    torch.testing.assert_close(robot.control_matrix(x), flat.control_matrix(x))


def test_links_keep_their_lengths_and_the_cost_its_period_and_bound():
    generator = torch.Generator().manual_seed(1)
    axes = torch.nn.functional.normalize(torch.randn(4, 3, generator=generator, dtype=torch.float64), dim=-1)
    rows = [shifted(0.3, axis.tolist()) for axis in axes] + [shifted(0.1, [0.0, 0.0, 0.0])]
    robot = RobotArm(chain=rows, target=[0.3, 0.3, 0.3], obstacles=[[0.4, 0.0, 0.2, 0.1]])
    x = states(4)
    lengths = robot.joints(x).diff(dim=1).norm(dim=-1)
    torch.testing.assert_close(lengths, torch.tensor([0.3] * 4 + [0.1], dtype=torch.float64).expand(200, 5))
    torch.testing.assert_close(robot.state_cost(x + torch.tensor([1.0, -2.0, 0.0, 3.0])), robot.state_cost(x))
    assert 0.0 <= float(robot.state_cost(x).min()) <= float(robot.state_cost(x).max()) <= robot.state_cost_bound


def test_a_file_gives_the_kinematics_of_the_library_and_is_not_needed_again(urdf):
    from yourdfpy import URDF

    robot, library = RobotArm(urdf=str(urdf)), URDF.load(str(urdf), load_meshes=False)
    x = states(3, 10)
    for k, angles in enumerate(robot.from_torus(x).tolist()):
        library.update_cfg(dict(zip(["j1", "j2", "j3"], angles, strict=True)))
        theirs = library.get_transform("tip")[:3, 3]
        np.testing.assert_allclose(robot.end_effector(robot.from_torus(x))[k].numpy(), theirs, atol=1e-12)
    urdf.unlink()
    again = RobotArm(**robot.parameters)
    assert torch.equal(again.state_cost(x), robot.state_cost(x))


def test_the_tip_may_be_any_link_behind_turning_joints(urdf):
    assert RobotArm(urdf=str(urdf), tip="c").dim == 2
    with pytest.raises(InputError, match="does not turn"):
        RobotArm(urdf=str(urdf), tip="slide")
    with pytest.raises(InputError, match="no joint on the way there turns"):
        RobotArm(urdf=str(urdf), tip="base")
    with pytest.raises(InputError, match="problem.tip is 'hand', but the links"):
        RobotArm(urdf=str(urdf), tip="hand")
    urdf.write_text("no robot")
    with pytest.raises(InputError, match="cannot be read as a URDF"):
        RobotArm(urdf=str(urdf))


def test_without_a_file_it_is_a_six_joint_arm_that_can_reach_its_target():
    robot = RobotArm()
    x = states(6, 4096)
    assert robot.dim == 6
    best = x[robot.distance(x).argmin()].clone().requires_grad_(True)
    for _ in range(300):
        (slope,) = torch.autograd.grad(robot.state_cost(best.unsqueeze(0)).sum(), best)
        best = (best - 0.01 * slope).detach().requires_grad_(True)
    assert float(robot.distance(best.detach().unsqueeze(0))) < 1e-3


def test_a_linkage_without_joints_is_no_problem():
    with pytest.raises(TypeError, match="abstract.*jacobian.*joints"):
        Linkage(2)


def test_wrong_arguments_are_refused():
    with pytest.raises(InputError, match="both given"):
        RobotArm(urdf="arm.urdf", chain=PLANAR)
    with pytest.raises(InputError, match="rows of 15 numbers"):
        RobotArm(chain=[PLANAR[0]])
    with pytest.raises(InputError, match=r"problem.chain\[1\]"):
        RobotArm(chain=[PLANAR[0], [0.0]])
    with pytest.raises(InputError, match=r"x, y, z, radius"):
        RobotArm(chain=PLANAR, obstacles="none")
    with pytest.raises(InputError, match=r"problem.obstacles\[0\]\[3\]"):
        RobotArm(chain=PLANAR, obstacles=[[0.1, 0.1, 0.1, -1.0]])


@pytest.mark.parametrize("problem", [RobotArm(), Arm(dim=3, lengths=[0.5, 0.3, 0.1])], ids=["space", "plane"])
def test_the_jacobian_is_the_slope_of_the_tip(problem):
    x = states(problem.dim, 20)
    slope = torch.func.vmap(torch.func.jacrev(lambda one: problem.end_effector(one[None])[0]))(x)
    torch.testing.assert_close(problem.jacobian(x), slope)


def test_the_gap_to_a_ball_is_what_points_along_the_links_say():
    robot = RobotArm(**ELBOW_AMONG_BALLS)
    joints = robot.joints(robot.from_torus(states(6, 50)))
    along = torch.linspace(0.0, 1.0, 2001, dtype=torch.float64).reshape(-1, 1)
    points = joints[:, :-1, None] + along * joints.diff(dim=1)[:, :, None]
    ball = torch.tensor(robot.obstacles[0], dtype=torch.float64)
    expected = (points - ball[:3]).norm(dim=-1).flatten(1).amin(dim=1) - ball[3]
    torch.testing.assert_close(robot.gap(states(6, 50)), expected, atol=1e-5, rtol=0.0)


@pytest.mark.nightly
def test_the_resolved_rate_law_reaches_the_target_in_space_and_a_picture_shows_it(tmp_path):
    robot = RobotArm(**ELBOW_AMONG_BALLS)
    policy = classical_policy(robot)
    found = metrics(robot, policy, seed=1, starts=24)
    assert found["classical"]["reached"] == 1.0
    assert found["zero"]["reached"] < 0.2
    figure = motion(robot, policy)
    assert {axes.name for axes in figure.axes} == {"3d"}
    figure.savefig(tmp_path / "motion.png", dpi=40)
    shades = Image.open(tmp_path / "motion.png").convert("L").getextrema()
    assert shades[0] < 100 < 250 < shades[1]
