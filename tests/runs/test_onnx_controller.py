"""ONNX files as controllers: exported ones are the controllers they came from, others the function they hold, or refused."""

import pytest
import torch

from ocp_torch import InputError
from ocp_torch.problems.exact.circle import Circle
from ocp_torch.problems.exact.torus import Torus
from ocp_torch.runs.loading import load_policy
from support.controllers import controllers

pytest.importorskip("onnxruntime")
onnx = pytest.importorskip("onnx")
FLOAT, WHOLE = onnx.TensorProto.FLOAT, onnx.TensorProto.INT64


def write(path, inputs=("x",), outputs=("u",), shape=("N", 1), number=FLOAT):
    """A model whose last output is the negative of its first input, and any others that input itself."""
    info, node = onnx.helper.make_tensor_value_info, onnx.helper.make_node
    kinds = ["Identity"] * (len(outputs) - 1) + ["Neg"]
    nodes = [node(kind, [inputs[0]], [name]) for kind, name in zip(kinds, outputs, strict=True)]
    given, found = ([info(name, number, list(shape)) for name in names] for names in (inputs, outputs))
    graph = onnx.helper.make_graph(nodes, "law", given, found)
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)])
    model.ir_version = 8
    onnx.save(model, str(path))
    return str(path)


@pytest.mark.parametrize("coordinates", ["torus", "physical"])
def test_an_exported_controller_is_judged_as_the_one_it_came_from(coordinates, tmp_path):
    """In units states are radians and rad/s, and a torque is twice what it is on the torus."""
    controller = controllers("dual", "problem=pendulum")[0]
    (file,) = controller.export(tmp_path / "u.onnx", coordinates=coordinates)
    x = torch.rand(64, controller.problem.dim, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    x = x[~controller.problem.outside(x)]  # beyond the box units have the control of the nearest state in it
    u = load_policy(str(file), controller.problem)(x).double()
    torch.testing.assert_close(u, controller(x), rtol=1e-3, atol=1e-4 * float(controller(x).abs().max()))
    if coordinates == "physical":
        with pytest.raises(InputError, match="physical units, which the problem does not have"):
            load_policy(str(file), Torus())


def test_of_several_outputs_the_control_is_taken_by_its_name(tmp_path):
    x = torch.rand(5, 1, dtype=torch.float64)
    for outputs in (("u",), ("value", "control")):
        found = load_policy(write(tmp_path / "u.onnx", outputs=outputs), Circle())(x)
        torch.testing.assert_close(found, -x.float())
    with pytest.raises(InputError, match=r"outputs \['value', 'u'\]; which is the control\? Call it control"):
        load_policy(write(tmp_path / "u.onnx", outputs=("value", "u")), Circle())


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (dict(inputs=("x", "t")), r"inputs \['x', 't'\], but must have one, states \(N, 1\)"),
        (dict(shape=(1, 1)), r"shape \(1, 1\), but must take \(N, 1\), with N free"),
        (dict(shape=("N", 2)), r"shape \('N', 2\), but must take \(N, 1\)"),
        (dict(shape=(1,)), r"shape \(1,\), but must take \(N, 1\)"),
        (dict(number=WHOLE), r"takes tensor\(int64\), but must take tensor\(double\) or tensor\(float\)"),
    ],
)
def test_a_model_of_something_else_is_refused(wrong, words, tmp_path):
    with pytest.raises(InputError, match=words):
        load_policy(write(tmp_path / "u.onnx", **wrong), Circle())


def test_a_damaged_file_is_refused(tmp_path):
    whole = (tmp_path / "u.onnx", tmp_path / "cut.onnx")
    write(whole[0])
    whole[1].write_bytes(whole[0].read_bytes()[:40])
    with pytest.raises(InputError, match="not a model that onnxruntime can run"):
        load_policy(str(whole[1]), Circle())
