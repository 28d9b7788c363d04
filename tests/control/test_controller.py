"""A controller comes back from its file with the same bits, and no damaged or crafted file ever becomes one."""

import copy
import json
import os
import pickle
import time
import warnings

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from ocp_torch import Angle, Circle, InputError, Problem, load_controller
from ocp_torch.control.described import plain_parameters
from ocp_torch.control.policies import trained_policies
from ocp_torch.files.storage import DIGEST_KEY, METADATA_KEY, digest
from support.controllers import CERTIFICATE, METHODS, SMALL, controller_of, controllers
from support.small import configured

pytestmark = pytest.mark.usefixtures("quick_composition")


def states(dim: int, count: int = 64) -> torch.Tensor:
    """Multiples of 1/1024, to which integers can be added exactly in every precision."""
    return torch.randint(1024, (count, dim), generator=torch.Generator().manual_seed(0)) / 1024.0


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A good file: the dual's controller on the sheared torus."""
    path = tmp_path_factory.mktemp("good") / "controller.safetensors"
    controllers("dual")[0].save(path)
    return path


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("method", METHODS)
def test_a_loaded_controller_is_the_saved_one_to_the_bit(method, dtype, tmp_path):
    for controller in controllers(method, f"trainer.dtype={dtype}"):
        path = tmp_path / "controller.safetensors"
        controller.save(path)
        loaded = load_controller(str(path))
        x = states(controller.problem.dim).to(getattr(torch, dtype))
        u = controller(x)
        assert u.shape == (64, controller.problem.control_dim)
        assert u.dtype == x.dtype
        assert u.std() > 1e-4
        assert torch.equal(loaded(x), u)
        assert type(loaded.problem) is type(controller.problem)
        assert loaded.problem.parameters == controller.problem.parameters
        assert (loaded.kind, loaded.constants) == (controller.kind, controller.constants)
        assert loaded.certificate == CERTIFICATE
        assert loaded.config == controller.config


def test_a_folder_stands_for_its_controller_or_for_that_of_the_newest_run_in_it(saved, tmp_path):
    runs = [tmp_path / "runs" / name for name in ("a", "b", "c")]
    for age, (run, method) in enumerate(zip(runs[:2], ("primal closed", "dual"), strict=True)):
        run.mkdir(parents=True)
        controllers(method)[0].save(run / "controller.safetensors")
        os.utime(run / "controller.safetensors", (1e9 - age, 1e9 - age))  # a is the newest
    runs[2].mkdir()  # a run that has not ended
    assert load_controller(runs[1]).kind == "value"
    assert load_controller(tmp_path / "runs").kind == load_controller(runs[0]).kind == "density"
    with pytest.raises(InputError, match=r"controller\.safetensors"):
        load_controller(runs[2])


@pytest.mark.parametrize("method", METHODS)
def test_any_real_state_is_wrapped_to_the_torus(method):
    for controller in controllers(method):
        x = states(controller.problem.dim)
        shift = torch.randint(-(10**6), 10**6, x.shape, generator=torch.Generator().manual_seed(1))
        # A sum that float64 holds exactly, and float32 could not.
        assert torch.equal(controller(x.double() + shift), controller(x.double()))
        assert torch.equal(controller(shift), controller(torch.zeros_like(x.double())))


@pytest.mark.parametrize("method", METHODS)
def test_controls_have_the_precision_of_the_states_and_are_off_by_their_rounding_alone(method):
    for controller in controllers(method):
        x = states(controller.problem.dim)
        single, double = controller(x), controller(x.double())
        assert (single.dtype, double.dtype) == (torch.float32, torch.float64)
        assert torch.equal(single, double.float())
        fields = copy.deepcopy(controller.fields).double()
        policy = trained_policies(controller.occupation, controller.problem, fields, controller.constants)
        with torch.no_grad():
            assert torch.equal(double, policy[controller.kind](x.double()))


def test_numpy_in_gives_numpy_out(saved):
    u = load_controller(saved)
    x = states(2)
    assert isinstance(u(x), torch.Tensor)
    for given in (x, x.double()):
        assert isinstance(u(given.numpy()), np.ndarray)
        np.testing.assert_array_equal(u(given.numpy()), u(given).numpy())
    assert u(np.zeros((0, 2))).shape == (0, 2)


def test_any_array_of_states_is_taken_as_it_is(saved):
    """Backwards, of another byte order, read-only: PyTorch takes none of them, or warns."""
    u, x = load_controller(saved), states(2).numpy()
    locked = x.copy()
    locked.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for given in (x[::-1][::-1], x.astype(">f4"), locked, np.asfortranarray(x)):
            np.testing.assert_array_equal(u(given), u(x))
        np.testing.assert_array_equal(u(x[::-1]), u(x)[::-1])


@pytest.mark.parametrize("method", METHODS)
def test_a_controller_is_copied_and_pickled(method):
    """As a pool of processes does with it."""
    for controller in controllers(method):
        x = states(controller.problem.dim)
        for other in (pickle.loads(pickle.dumps(controller)), copy.deepcopy(controller)):
            assert torch.equal(other(x), controller(x))
            assert (other.kind, other.certificate) == (controller.kind, controller.certificate)


@pytest.mark.parametrize("shape", [(), (2,), (4, 1), (4, 3), (4, 2, 2), (0,)])
def test_another_shape_is_refused_with_the_shape_that_is_right(saved, shape):
    u = load_controller(saved)
    for x in (torch.zeros(shape), np.zeros(shape)):
        with pytest.raises(InputError, match=r"must have shape \(N, 2\)"):
            u(x)


@pytest.mark.parametrize(
    "given", [{"observation": [0.0, 0.0]}, None, "state", [[0.0, 0.0], [0.0]], np.array([None, 1])]
)
def test_what_is_no_array_of_numbers_is_refused(saved, given):
    with pytest.raises(InputError, match=r"^x is .*, but must be numbers of shape \(N, 2\)\.$"):
        load_controller(saved)(given)


class Valley(Problem):
    """A user's own problem, with an argument of its own."""

    def __init__(self, dim: int = 2, depth: float = 1.0) -> None:
        super().__init__(dim=dim)
        self.depth = depth

    def state_cost(self, x):
        return self.depth * (1.0 + (2.0 * torch.pi * x).cos().mean(dim=-1))


class Capped(Valley):
    """Infinity is a natural default for a limit that is not there."""

    def __init__(self, cap: float = float("inf")) -> None:
        super().__init__()
        self.cap = cap


def test_a_controller_of_your_own_problem_asks_for_it_and_works_with_it(tmp_path):
    path, mine = tmp_path / "controller.safetensors", Valley(2, 3.0)
    controller = controller_of(configured(*SMALL, "method=dual", "problem=torus"), mine)[0]
    controller.save(path)
    with pytest.raises(InputError, match="problem=") as refused:
        load_controller(path)
    assert_one_sentence(refused)
    loaded = load_controller(path, problem=Valley(2, 3.0))
    assert torch.equal(loaded(states(2)), controller(states(2)))
    assert loaded.problem.depth == 3.0
    with pytest.raises(InputError, match="dimension 3"):
        load_controller(path, problem=Valley(3))


def test_a_problem_of_your_own_is_not_mistaken_for_the_built_in_one_of_the_same_name(tmp_path):
    class Sluggish(Problem):
        def __init__(self, discount: float = 2.0) -> None:
            super().__init__(dim=1, discount=discount)

        def control_matrix(self, x):
            return 0.1 * super().control_matrix(x)

    Sluggish.__name__ = "Circle"
    path = tmp_path / "controller.safetensors"
    controller_of(configured(*SMALL, "method=dual"), Sluggish())[0].save(path)
    with pytest.raises(InputError, match="problem="):
        load_controller(path)


def test_a_problem_with_an_infinite_argument_does_not_lose_its_controller(tmp_path):
    path, config = tmp_path / "controller.safetensors", configured(*SMALL, "method=dual", "problem=torus")
    controller = controller_of(config, Capped())[0]
    controller.config = config | {"problem": {"_target_": "my_module.Capped", "cap": float("inf")}}
    controller.save(path)
    assert torch.equal(load_controller(path, problem=Capped())(states(2)), controller(states(2)))


class Movable(Problem):
    """Lists and mappings are arguments as natural as numbers, and may hold what no file does."""

    def __init__(self, coordinates=None, gains=None, ranges=((0.0, 1.0),)) -> None:
        super().__init__(dim=2)
        self.coordinates, self.ranges = coordinates or [Angle("angle")], ranges
        self.gains = gains or {"low": 1.0, 2: 3.0}

    def state_cost(self, x):
        return self.gains["low"] * (1.0 + (2.0 * torch.pi * x).cos().mean(dim=-1))


def test_an_argument_that_no_file_can_hold_does_not_lose_a_controller(tmp_path):
    path = tmp_path / "controller.safetensors"
    controller_of(configured(*SMALL, "method=dual", "problem=torus"), Movable())[0].save(path)
    assert load_controller(path, problem=Movable()).problem.ranges == ((0.0, 1.0),)
    endless = [1.0]
    endless.append(endless)
    assert plain_parameters({"ranges": endless, "gains": {"low": endless}, "depth": 3.0}) == {"depth": 3.0}
    with pytest.raises(InputError, match=r"problem.ranges is \[\[0.0, 2.0\]\], but the run of .* has \[\[0.0, 1.0\]\]"):
        load_controller(path, problem=Movable(ranges=((0.0, 2.0),)))


def test_a_controller_is_not_loaded_with_other_numbers_in_a_mapping(tmp_path):
    path, mine = tmp_path / "controller.safetensors", Movable(gains={"low": 1.0, "limits": (0.0, 1.0)})
    controller_of(configured(*SMALL, "method=dual", "problem=torus"), mine)[0].save(path)
    load_controller(path, problem=Movable(gains={"low": 1.0, "limits": [0.0, 1.0]}))
    with pytest.raises(InputError, match="problem.gains"):
        load_controller(path, problem=Movable(gains={"low": 2.0, "limits": (0.0, 1.0)}))
    all_at_once = r"problem.gains is .* and problem.ranges is \[\], but the run of .* has {.*} and \[\[0.0, 1.0\]\]; a"
    with pytest.raises(InputError, match=all_at_once):
        load_controller(path, problem=Movable(gains={"low": 2.0}, ranges=()))


def test_a_controller_is_not_loaded_for_another_problem(saved):
    with pytest.raises(InputError, match="'torus'"):
        load_controller(saved, problem=Circle())


def assert_one_sentence(refused) -> str:
    sentence = str(refused.value)
    assert "\n" not in sentence
    assert sentence.endswith(".")
    return sentence


def refusal(path) -> str:
    """The sentence with which loading ``path`` is refused."""
    with pytest.raises(InputError) as refused:
        load_controller(path)
    return assert_one_sentence(refused)


def signed(path, tensors: dict, metadata: str):
    """A file whose digest is right, whatever it holds, so that the checks behind the digest are on their own."""
    save_file(tensors, str(path), metadata={METADATA_KEY: metadata, DIGEST_KEY: digest(tensors, metadata)})
    return path


def parts(path) -> tuple[dict, dict]:
    with safe_open(str(path), framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, json.loads(file.metadata()[METADATA_KEY])  # noqa: SIM118


class Canary:
    """Unpickled, it would leave a file behind."""

    def __init__(self, path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_a_file_that_is_no_controller_is_refused_and_nothing_in_it_runs(saved, tmp_path):
    good, canary = saved.read_bytes(), tmp_path / "canary"
    path = tmp_path / "controller.safetensors"
    assert "does not exist" in refusal(path)
    for count in (0, 1, 7, 8, 9, 100, len(good) // 2, len(good) - 1):
        path.write_bytes(good[:count])
        refusal(path)
    path.write_bytes(pickle.dumps(Canary(canary)))
    refusal(path)
    torch.save({"weights": Canary(canary)}, path)
    refusal(path)
    save_file({"weight": torch.zeros(2)}, str(path), metadata={"format": "pt"})
    assert "not written by ocp_torch" in refusal(path)
    assert not canary.exists()
    path.write_bytes(good)
    load_controller(path)


def test_one_flipped_bit_anywhere_is_noticed(saved, tmp_path):
    good, path = saved.read_bytes(), tmp_path / "controller.safetensors"
    load_controller(saved)
    for position in range(0, len(good), 3):
        damaged = bytearray(good)
        damaged[position] ^= 1 << position % 8
        path.write_bytes(damaged)
        refusal(path)


CRAFTED = {
    "schema": [4, "1", None, 1.5],
    "problem.name": ["os.system", "../x", "builtins.eval", "Torus", 5, ["torus"]],
    "problem.parameters": [{"dim": 10**9}, {"dim": 0}, {"discount": -1.0}, {"discount": 1e300}, {"colour": 1}, 3],
    "model.name": ["os.system", "../x", None],
    "model.width": [10**9, 2**40, 0, 9, 1e9, "8"],
    "model.depth": [10**9, 1],
    "model.modes": [10**9, -1],
    "model.activation": ["os.system", "relu"],
    "model.dim": [2],
    "dtype": ["float16", "os", "float32\nx", 32],
    "fields": [["control_density"], ["value", "value2"], [], "value", None],
    "kind": ["density", "best", None],
    "occupation": ["open", 1],
    "bounds": [{}, {"M": 1.0}, None],
    "bounds.M": ["big", None],
}
WRONG_VALUES = [(field, value) for field, values in CRAFTED.items() for value in values]


@pytest.mark.parametrize(("field", "value"), WRONG_VALUES, ids=lambda v: str(v))
def test_crafted_metadata_with_a_right_digest_is_refused_and_nothing_in_it_runs(field, value, saved, tmp_path):
    tensors, metadata = parts(saved)
    load_controller(signed(tmp_path / "controller.safetensors", tensors, json.dumps(metadata)))
    canary = tmp_path / "canary"
    metadata["problem"]["parameters"] |= {"command": f"mkdir {canary}"} if "." in str(value) else {}
    *groups, name = field.split(".")
    section = metadata
    for group in groups:
        section = section[group]
    section[name] = value
    refusal(signed(tmp_path / "controller.safetensors", tensors, json.dumps(metadata)))
    assert not canary.exists()


@pytest.mark.parametrize(("group", "value"), [("model", {"depth": 20_000}), ("problem", {"dim": 6_000})])
def test_what_a_crafted_file_asks_for_is_not_built_before_it_is_held_against_its_weights(group, value, saved, tmp_path):
    tensors, metadata = parts(saved)
    section = metadata["problem"]["parameters"] if group == "problem" else metadata["model"]
    section |= value
    path = signed(tmp_path / "controller.safetensors", tensors, json.dumps(metadata))
    start = time.perf_counter()
    refusal(path)
    assert time.perf_counter() - start < 2.0


@pytest.mark.parametrize("field", ["schema", "problem", "model", "dtype", "fields", "bounds", "kind", "occupation"])
def test_missing_metadata_is_refused(field, saved, tmp_path):
    tensors, metadata = parts(saved)
    del metadata[field]
    refusal(signed(tmp_path / "controller.safetensors", tensors, json.dumps(metadata)))


@pytest.mark.parametrize("text", ["", "not JSON", "[1, 2]", "7", "[" * 100_000, "1" * 5_000], ids=lambda t: t[:8])
def test_metadata_that_is_no_json_object_is_refused(text, saved, tmp_path):
    tensors, _ = parts(saved)
    refusal(signed(tmp_path / "controller.safetensors", tensors, text))


def test_weights_that_are_not_finite_or_do_not_fit_are_refused(saved, tmp_path):
    tensors, metadata = parts(saved)
    path, text, name = tmp_path / "controller.safetensors", json.dumps(metadata), "networks.value.head.weight"
    load_controller(signed(path, tensors, text))
    for bad in (float("nan"), float("inf")):
        assert "not finite" in refusal(signed(path, tensors | {name: torch.full_like(tensors[name], bad)}, text))
    assert "does not fit" in refusal(signed(path, tensors | {name: tensors[name][:, 1:].contiguous()}, text))
    assert "does not fit" in refusal(signed(path, {k: t for k, t in tensors.items() if k != name}, text))
    assert "does not fit" in refusal(signed(path, tensors | {"more": torch.zeros(1)}, text))
