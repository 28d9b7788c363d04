"""Operations of a user's dynamics in every format: functions that ONNX has in single precision alone, sums and products."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
import torch

from ocp_torch.export import export

COUNT = 2000
FUNCTIONS = {
    "erf": torch.erf,
    "tan": torch.tan,
    "atan": lambda x: torch.atan(3.0 * x),
    "asin": lambda x: torch.asin((3.0 * x).sin()),
    "acos": lambda x: torch.acos(x.clamp(-1.0, 1.0)),
    "sinh": torch.sinh,
    "cosh": torch.cosh,
    "exp2": torch.exp2,
    "gelu": lambda x: torch.nn.functional.gelu(4.0 * x),
    "cumsum": lambda x: x.cumsum(dim=1),
    "prod": lambda x: x.prod(dim=1, keepdim=True) + x,
    "all": lambda x: x.prod(dim=-1).unsqueeze(1) * x.cumsum(dim=-1).tan(),
}


def states() -> torch.Tensor:
    x = 6.0 * torch.rand(COUNT, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 3.0
    x[0], x[1] = 1.0, -1.0  # the ends of arc sines
    return x.clamp(-1.4, 1.4)  # where a tangent is no larger than ten


@pytest.mark.parametrize("name", FUNCTIONS)
def test_an_operation_is_the_same_in_every_format(name, tmp_path):
    x, of = states(), FUNCTIONS[name]
    function = lambda s: {"control": of(s)}
    wanted = function(x)["control"]
    size = max(1.0, float(wanted.abs().max()))

    onnxruntime = pytest.importorskip("onnxruntime")
    single = x.float()
    exact = function(single.double())["control"]
    (file,) = export(function, x[:8], tmp_path / "f.onnx", None, "about", {})
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {"state": single.numpy()})
    assert float((torch.tensor(found).double() - exact).abs().max()) < 1e-7 * size

    casadi = pytest.importorskip("casadi")
    (file,) = export(function, x[:8], tmp_path / "f.casadi", None, "about", {})
    found = casadi.Function.load(str(file)).map(len(x))(x.numpy().T).full().T
    assert np.abs(found - wanted.numpy()).max() < 1e-12 * size

    if shutil.which("gcc") is None:
        return
    export(function, x[:8], tmp_path / "f.c", None, "about", {})
    strict = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC"]
    subprocess.run(["gcc", *strict, "-o", str(tmp_path / "f.so"), str(tmp_path / "f.c"), "-lm"], check=True)
    compiled, given = ctypes.CDLL(str(tmp_path / "f.so")), np.ascontiguousarray(x.numpy())
    found = np.full((len(x), wanted.shape[1]), np.nan)
    for row, out in zip(given, found, strict=True):
        compiled.f_control(ctypes.c_void_p(row.ctypes.data), ctypes.c_void_p(out.ctypes.data))
    assert np.abs(found - wanted.numpy()).max() < 1e-12 * size
