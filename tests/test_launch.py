"""Kernel calls by name: every mistake is an error that names it before anything runs, and nobody passes a bare list."""

import ast
import weakref
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import warp as wp

from r2h_batch.launch import init_warp, launch, launch_trials, load
from r2h_batch.launch.arguments import parameters, struct_of

ROOT = Path(__file__).parents[1]
KERNELS = Path(str(import_module("r2h_batch.kernels").__path__[0]))


@wp.struct
class Scale:
    factor: float


@wp.struct
class Other:
    factor: float


@wp.kernel
def scaled(
    first: int,
    scale: Scale,
    power: int,
    offset: float,
    turn: wp.mat33,
    point_in: wp.array(dtype=wp.vec3),
    weight_in: wp.array(dtype=float),
    table: wp.array2d(dtype=float),
    length_out: wp.array(dtype=float),
    calls_inout: wp.array(dtype=int),
):
    i = first + wp.tid()
    length = wp.length(turn * point_in[i]) * weight_in[i] * scale.factor + offset + table[0, 1]
    length_out[i] = wp.pow(length, float(power))
    calls_inout[i] = calls_inout[i] + 1


@wp.struct
class Table:
    weight: wp.array(dtype=float)
    count: wp.array(dtype=int)


@wp.kernel
def weighted(first: int, table: Table, y_out: wp.array(dtype=float)):
    i = first + wp.tid()
    y_out[i] = table.weight[i] * float(table.count[i])


@wp.kernel
def doubled(x_in: wp.array(dtype=wp.float64), x_out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    x_out[i] = wp.float64(2.0) * x_in[i]


N = 7


@pytest.fixture(autouse=True, scope="module")
def _warp():
    init_warp()


def arguments(n: int = N, **other):
    """(inputs, outputs) of `scaled` for n trials; `other` replaces values by name."""
    scale = Scale()
    scale.factor = 2.0
    g = torch.Generator().manual_seed(0)
    inputs = {
        "scale": scale,
        "power": 1,
        "offset": 0.5,
        "turn": wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        "point": torch.rand((n, 3), generator=g),
        "weight": torch.rand(n, generator=g),
        "table": torch.tensor([[0.0, 0.25]]),
    }
    outputs = {"length": torch.full((n,), -1.0), "calls": torch.zeros(n, dtype=torch.int32)}
    for name, value in other.items():
        (inputs if name in inputs else outputs)[name] = value
    return inputs, outputs


def refused(match: str, inputs, outputs, error=TypeError) -> None:
    """The call fails with these words, and the outputs are as they were."""
    before = {k: v.clone() for k, v in outputs.items() if isinstance(v, torch.Tensor)}
    with pytest.raises(error, match=match):
        launch_trials(scaled, N, inputs=inputs, outputs=outputs, device="cpu")
    for name, value in before.items():
        assert torch.equal(outputs[name], value)


def expected(inputs) -> torch.Tensor:
    return inputs["point"].norm(dim=1) * inputs["weight"] * 2.0 + 0.5 + 0.25


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("chunk", [1, 3, 100])
def test_every_trial_is_computed_once_for_any_threads_and_chunk(threads, chunk):
    inputs, outputs = arguments(50)
    launch_trials(scaled, 50, inputs=inputs, outputs=outputs, device="cpu", threads=threads, chunk=chunk)
    torch.testing.assert_close(outputs["length"], expected(inputs))
    assert (outputs["calls"] == 1).all()


def test_a_range_of_trials_leaves_the_others_alone():
    inputs, outputs = arguments()
    launch_trials(scaled, 3, inputs=inputs, outputs=outputs, device="cpu", first=2)
    assert outputs["calls"].tolist() == [0, 0, 1, 1, 1, 0, 0]


def test_tensors_arrays_and_warp_arrays_give_the_same_bits():
    inputs, outputs = arguments()
    launch_trials(scaled, N, inputs=inputs, outputs=outputs, device="cpu")
    as_numpy, numpy_out = arguments(length=np.zeros(N, np.float32), calls=np.zeros(N, np.int32))
    as_numpy = {k: v.numpy() if isinstance(v, torch.Tensor) else v for k, v in as_numpy.items()}
    as_numpy["point"] = as_numpy["point"].view(trimesh.caching.TrackedArray)  # what a mesh's vertices are
    launch_trials(scaled, N, inputs=as_numpy, outputs=numpy_out, device="cpu")
    as_warp, _ = arguments()
    as_warp["point"] = wp.from_torch(as_warp["point"], dtype=wp.vec3)
    warp_out = {"length": wp.zeros(N, dtype=float, device="cpu"), "calls": wp.zeros(N, dtype=int, device="cpu")}
    launch_trials(scaled, N, inputs=as_warp, outputs=warp_out, device="cpu")
    for other in (numpy_out["length"], warp_out["length"].numpy()):
        np.testing.assert_array_equal(outputs["length"].numpy(), other)


def test_a_tensor_that_wants_a_gradient_is_passed_by_value_and_gets_none():
    inputs, outputs = arguments()
    inputs["weight"].requires_grad_()
    launch_trials(scaled, N, inputs=inputs, outputs=outputs, device="cpu")
    torch.testing.assert_close(outputs["length"], expected(inputs).detach())
    assert inputs["weight"].grad is None


def test_a_repeated_call_takes_the_memory_rows_and_values_it_is_given():
    for n in (N, 3, 50, 0, N):
        for power, offset in ((1, 0.5), (2, 0.25), (1, -0.0)):
            inputs, outputs = arguments(n, power=power, offset=offset)
            inputs["point"] = torch.rand((n, 3))
            launch_trials(scaled, n, inputs=inputs, outputs=outputs, device="cpu", threads=2, chunk=20)
            length = inputs["point"].norm(dim=1) * inputs["weight"] * 2.0 + offset + 0.25
            torch.testing.assert_close(outputs["length"], length**power)
            assert (outputs["calls"] == 1).all()


def test_a_recording_of_the_cpu_is_refused_before_and_after_a_first_call():
    load(scaled, "cpu")
    for inputs, outputs in (arguments(), arguments()):
        with wp.ScopedCapture(device="cpu"):
            refused("Warp records a graph on the CPU, and scaled would be missing", inputs, outputs, RuntimeError)
        launch_trials(scaled, N, inputs=inputs, outputs=outputs, device="cpu")
        torch.testing.assert_close(outputs["length"], expected(inputs))


def test_a_struct_whose_numbers_change_and_another_one_are_both_seen():
    inputs, outputs = arguments()
    for factor in (2.0, 3.0):
        inputs["scale"].factor = factor
        launch_trials(scaled, N, inputs=inputs, outputs=outputs, device="cpu")
        torch.testing.assert_close(outputs["length"], (expected(inputs) - 0.75) * factor / 2.0 + 0.75)
    other, _ = arguments(scale=Scale())
    launch_trials(scaled, N, inputs=other, outputs=outputs, device="cpu")
    torch.testing.assert_close(outputs["length"], torch.full((N,), 0.75))


def test_what_is_refused_the_first_time_is_refused_after_a_call_that_was_right():
    inputs, outputs = arguments()
    launch_trials(scaled, N, inputs=inputs, outputs=outputs, device="cpu")
    for name, value in {
        "point": torch.rand((N, 2)),
        "weight": torch.rand(N, dtype=torch.float64),
        "table": torch.rand((2, 4)).T,
        "power": 1.5,
        "scale": Other(),
    }.items():
        refused(f"`{name}`", {**inputs, name: value}, outputs)
    refused("`length`", inputs, {**outputs, "length": torch.zeros(N - 1)}, ValueError)
    refused("unknown", {**inputs, "wait": 1}, outputs)
    refused("missing", {k: v for k, v in inputs.items() if k != "weight"}, outputs)
    launch_trials(scaled, N, inputs=inputs, outputs=outputs, device="cpu")
    torch.testing.assert_close(outputs["length"], expected(inputs))


def test_callers_in_threads_do_not_see_each_others_memory():
    def many(seed: int) -> bool:
        right = True
        for n in [2, 40] * 20:
            inputs, outputs = arguments(n, offset=float(seed))
            launch_trials(scaled, n, inputs=inputs, outputs=outputs, device="cpu", threads=2, chunk=16)
            length = inputs["point"].norm(dim=1) * inputs["weight"] * 2.0 + seed + 0.25
            right = right and torch.allclose(outputs["length"], length) and bool((outputs["calls"] == 1).all())
        return right

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(many, range(4)))


def test_a_struct_made_of_tensors_keeps_their_memory_and_refuses_other_kinds():
    made = struct_of(Table, {"weight": torch.full((N,), 2.0), "count": torch.arange(N, dtype=torch.int32)})
    others = [torch.full((N,), 7.0) for _ in range(20)]  # would take the memory if it were free
    out = torch.zeros(N)
    launch_trials(weighted, N, inputs={"table": made}, outputs={"y": out}, device="cpu")
    assert out.tolist() == [2.0 * i for i in range(N)] and len(others) == 20
    for n, weight in ((N, 3.0), (5, 4.0), (5, 5.0), (N, 6.0)):  # the same sizes again, and others
        made = struct_of(Table, {"weight": torch.full((n,), weight), "count": torch.arange(n, dtype=torch.int32)})
        launch_trials(weighted, n, inputs={"table": made}, outputs={"y": out}, device="cpu")
        assert out[:n].tolist() == [weight * i for i in range(n)]
    with pytest.raises(TypeError, match="`weight`"):
        struct_of(Table, {"weight": torch.zeros(N, dtype=torch.float64), "count": torch.zeros(N, dtype=torch.int32)})


def test_memory_of_a_call_is_given_back_after_it():
    """What is kept for the next call is addresses, not what stands there."""
    inputs, outputs = arguments()
    launch_trials(scaled, N, inputs=inputs, outputs=outputs, device="cpu")
    gone = [weakref.ref(x) for x in (inputs["scale"], inputs["point"], outputs["length"])]
    del inputs, outputs
    assert [x() for x in gone] == [None] * 3


def test_nothing_to_do_is_checked_all_the_same():
    inputs, outputs = arguments(0)
    launch_trials(scaled, 0, inputs=inputs, outputs=outputs, device="cpu")
    with pytest.raises(TypeError, match="`point`"):
        launch_trials(scaled, 0, inputs={**inputs, "point": torch.empty(0, 2)}, outputs=outputs, device="cpu")


def test_one_name_on_both_sides_and_a_kernel_without_first():
    x, y = np.arange(4.0), np.zeros(4)
    launch(doubled, 4, inputs={"x": x}, outputs={"x": y}, device="cpu")
    assert y.tolist() == [0, 2, 4, 6]
    with pytest.raises(TypeError, match="kernel doubled lacks a leading parameter `first`: use launch"):
        launch_trials(doubled, 4, inputs={"x": x}, outputs={"x": y}, device="cpu")
    with pytest.raises(TypeError, match="kernel scaled has a leading parameter `first`: use launch_trials"):
        launch(scaled, 4, inputs={}, outputs={}, device="cpu")


def test_wrong_names():
    inputs, outputs = arguments()
    refused(
        r"kernel scaled: input `wieght` is unknown \(did you mean `weight`\?\); input `weight` missing",
        {("wieght" if k == "weight" else k): v for k, v in inputs.items()},
        outputs,
    )
    refused("input `more` is unknown", {**inputs, "more": 1}, outputs)
    refused("input `point_in` is unknown.*did you mean `point`", {**inputs, "point_in": inputs["point"]}, outputs)
    refused("input `offset` missing", {k: v for k, v in inputs.items() if k != "offset"}, outputs)
    refused("output `length` missing", inputs, {"calls": outputs["calls"]})
    refused("It declares inputs scale, power, .*; outputs length, calls", {}, outputs)


def test_an_input_given_as_output_and_the_reverse():
    inputs, outputs = arguments()
    weight = inputs.pop("weight")
    refused("`weight` is given as output, the kernel declares it as input", inputs, {**outputs, "weight": weight})
    inputs, outputs = arguments()
    length = outputs.pop("length")
    refused("`length` is given as input, the kernel declares it as output", {**inputs, "length": length}, outputs)
    inputs, outputs = arguments()
    refused("`weight` is given as output", inputs, {**outputs, "weight": inputs["weight"]})  # twice


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"point": torch.rand(N), "weight": torch.rand(N, 3)}, r"input `point` \(parameter point_in\) is a tensor of float32 "
         rf"with shape \({N},\) on cpu; the kernel declares 1 dimension\(s\) of vec3f: .* float32 with shape \(n, 3\)"),
        ({"weight": torch.rand(N, dtype=torch.float64)}, "input `weight` .* is a tensor of float64"),
        ({"weight": np.zeros(N)}, "input `weight` .* is a NumPy array of float64"),
        ({"weight": wp.zeros(N, dtype=int, device="cpu")}, "input `weight` .* is a wp.array of int32"),
        ({"point": wp.zeros(N, dtype=wp.vec4, device="cpu")}, "input `point` .* is a wp.array of vec4f"),
        ({"calls": torch.zeros(N)}, "output `calls` .* is a tensor of float32"),
        ({"weight": torch.rand(N, 1)}, r"input `weight` .* with shape \(7, 1\)"),
        ({"table": torch.rand(2)}, r"input `table` .* with shape \(2,\)"),
        ({"table": wp.zeros(3, dtype=float, device="cpu")}, r"input `table` .* 2 dimension"),
        ({"point": torch.rand(N, 4)}, r"input `point` .* with shape \(7, 4\)"),
        ({"weight": torch.rand(2 * N)[::2]}, "input `weight` .* is a non-contiguous tensor"),
        ({"point": torch.rand(3, N).T}, "input `point` .* is a non-contiguous tensor"),
        ({"weight": np.zeros(2 * N, np.float32)[::2]}, "input `weight` .* is a non-contiguous NumPy array"),
        ({"weight": wp.zeros(2 * N, dtype=float, device="cpu")[::2]}, "input `weight` .* is a non-contiguous wp.array"),
        ({"length": torch.zeros(2 * N)[::2]}, "output `length` .* is a non-contiguous tensor"),
        ({"weight": torch.rand(N, device="meta")}, "input `weight` .* on meta"),
        ({"weight": [1.0] * N}, "input `weight` .* is .*list"),
        ({"weight": None}, "input `weight` .* is None"),
        ({"scale": Other()}, "input `scale` .* is a struct .*Other; the kernel declares a struct .*Scale"),
        ({"scale": 2.0}, r"input `scale` .* is 2.0 \(float\)"),
        ({"power": 2.0}, r"input `power` .* is 2.0 \(float\); the kernel declares int32"),
        ({"power": True}, r"input `power` .* is True \(bool\)"),
        ({"offset": "1"}, r"input `offset` .* is '1' \(str\); the kernel declares float32"),
        ({"offset": torch.tensor(1.0)}, "input `offset` .* is a tensor"),
        ({"turn": wp.mat22(1.0, 0.0, 0.0, 1.0)}, "input `turn` .* the kernel declares mat33f"),
    ],
)  # fmt: skip
def test_wrong_kinds(change, match):
    refused("kernel scaled: " + match, *arguments(**change))


def test_an_output_with_too_few_rows():
    refused(
        f"output `length` .* has 6 rows; {N} trials write {N} or more", *arguments(length=torch.zeros(6)), ValueError
    )


def _functions(tree: ast.AST, decorator: str):
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and any(
            ast.unparse(d).split("(")[0] == decorator for d in node.decorator_list
        ):
            yield node


def _kernels():
    """Every kernel of the package: (file, its syntax, the kernel)."""
    for file in sorted(KERNELS.rglob("*.py")):
        name = ".".join(("r2h_batch.kernels", *file.relative_to(KERNELS).with_suffix("").parts))
        for node in _functions(ast.parse(file.read_text()), "wp.kernel"):
            yield file, node, getattr(import_module(name), node.name)


def _queues(kernel) -> set[str]:
    """Parameters that are queues of kernels/frontier/: every stage reads them and adds to them, and their type says so."""
    kinds = {a.label: getattr(getattr(a.type, "cls", None), "__module__", "") for a in kernel.adj.args}
    return {label for label, module in kinds.items() if module.startswith("r2h_batch.kernels.frontier.")}


def test_what_a_kernel_writes_is_an_output():
    """Assignments to a parameter's elements or fields, in the kernel itself: the launcher trusts the parameters' names."""
    seen, wrong = 0, []
    for file, node, kernel in _kernels():
        seen += 1
        written = {p.label for p in parameters(kernel) if p.written} | _queues(kernel)
        assert written, f"{kernel.key} declares no output"
        names = [p.name for p in parameters(kernel)]
        inputs = [p.name for p in parameters(kernel) if not p.written]
        assert len(set(inputs)) == len(inputs) and len(names) - len(inputs) == len(
            {p.name for p in parameters(kernel) if p.written}
        )
        arguments = {a.arg for a in node.args.args}
        for part in ast.walk(node):
            targets = (
                part.targets
                if isinstance(part, ast.Assign)
                else [part.target]
                if isinstance(part, ast.AugAssign)
                else []
            )
            for target in targets:
                base = target
                while isinstance(base, (ast.Subscript, ast.Attribute)):
                    base = base.value
                if base is not target and isinstance(base, ast.Name) and base.id in arguments - written:
                    wrong.append(f"{file.name}: {kernel.key} writes {base.id}")
    assert seen > 30 and not wrong, wrong


def test_nobody_launches_with_a_list():
    """Each call names its arguments by `inputs` and `outputs`; only the launcher itself calls Warp's."""
    sources = [
        f for d in ("r2h_batch", "kernels", "assets", "bench", "examples", "tests") for f in (ROOT / d).rglob("*.py")
    ]
    seen = 0
    for file in sources:
        for node in ast.walk(ast.parse(file.read_text())):
            if not isinstance(node, ast.Call):
                continue
            called = ast.unparse(node.func)
            assert called not in ("wp.launch", "warp.launch") or file.parent == ROOT / "r2h_batch" / "launch", (
                f"{file.relative_to(ROOT)}:{node.lineno} calls {called}: use r2h_batch.launch"
            )
            passed_on = any(isinstance(a, ast.Starred) for a in node.args)  # a bench's wrapper around the launcher
            if called.rsplit(".", 1)[-1] not in ("launch", "launch_trials") or called.startswith("wp.") or passed_on:
                continue
            if not isinstance(node.func, ast.Name) or len(node.args) == 0:
                continue  # a method of that name
            seen += 1
            given = {k.arg for k in node.keywords}
            assert len(node.args) == 2 and {"inputs", "outputs"} <= given, (
                f"{file.relative_to(ROOT)}:{node.lineno} passes {len(node.args)} positional arguments, and by name {given}"
            )
    assert seen > 40
