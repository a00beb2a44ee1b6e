"""Kernel calls by name: every mistake is an error that names it before anything runs, and nobody passes a bare list."""

import ast
import threading
import time
from importlib import import_module
from pathlib import Path

import pytest
import torch
import warp as wp

from r2h_batch.base.launch import cached, init_warp, launch_trials, threads
from r2h_batch.base.launch.arguments import parameters, struct_of

ROOT = Path(__file__).parents[2]
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


def test_a_repeated_call_takes_the_memory_rows_and_values_it_is_given():
    for n in (N, 3, 50, 0, N):
        for power, offset in ((1, 0.5), (2, 0.25), (1, -0.0)):
            inputs, outputs = arguments(n, power=power, offset=offset)
            inputs["point"] = torch.rand((n, 3))
            launch_trials(scaled, n, inputs=inputs, outputs=outputs, device="cpu", threads=2, chunk=20)
            length = inputs["point"].norm(dim=1) * inputs["weight"] * 2.0 + offset + 0.25
            torch.testing.assert_close(outputs["length"], length**power)
            assert (outputs["calls"] == 1).all()


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
    refused(
        f"output `length` .* has {N - 1} rows; {N} trials write {N} or more",
        inputs,
        {**outputs, "length": torch.zeros(N - 1)},
        ValueError,
    )
    refused("unknown", {**inputs, "wait": 1}, outputs)
    refused("missing", {k: v for k, v in inputs.items() if k != "weight"}, outputs)
    launch_trials(scaled, N, inputs=inputs, outputs=outputs, device="cpu")
    torch.testing.assert_close(outputs["length"], expected(inputs))


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


def test_what_a_kernel_writes_is_an_output():
    """Assignments to a parameter's elements or fields, in the kernel itself: the launcher trusts the parameters' names."""
    seen, wrong = 0, []
    for file, node, kernel in _kernels():
        seen += 1
        written = {p.label for p in parameters(kernel) if p.written}
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


def test_only_the_launcher_calls_warps_launch():
    files = (f for d in ("r2h_batch", "kernels", "assets", "bench", "examples") for f in (ROOT / d).rglob("*.py"))
    called = [f for f in files if "wp.launch(" in f.read_text() and f.parent != ROOT / "r2h_batch" / "base" / "launch"]
    assert called == []


# --- repeated calls, interrupts, exit -----------------------------------------------------------------------------------


@pytest.mark.parametrize("guards", [True, False])
def test_a_repeated_call_takes_tensors_that_are_given_twice_and_sees_them_change(monkeypatch, guards):
    if not guards:  # a torch without them
        monkeypatch.setattr("r2h_batch.base.launch.arguments.TENSOR_GUARDS", None)

    @wp.kernel(module="unique")
    def added(first: int, a_in: wp.array(dtype=float), b_in: wp.array(dtype=float), sum_out: wp.array(dtype=float)):
        i = first + wp.tid()
        sum_out[i] = a_in[i] + b_in[i]

    for n in (3, 3, 5, 5):
        x, y, out = torch.rand(n), torch.rand(n), torch.empty(n)
        for a, b in ((x, x), (x, y), (y, x), (y, y), (x, x)):
            launch_trials(added, n, inputs={"a": a, "b": b}, outputs={"sum": out}, device="cpu")
            assert torch.equal(out, a + b)
    wrong = torch.rand(5, dtype=torch.float64)
    for a, b in ((wrong, wrong), (x, wrong), (wrong, x)):
        with pytest.raises(TypeError, match=r"is a tensor of float64 with shape \(5,\)"):
            launch_trials(added, 5, inputs={"a": a, "b": b}, outputs={"sum": out}, device="cpu")
    with pytest.raises(ValueError, match="has 5 rows; 6 trials write 6 or more"):
        launch_trials(added, 6, inputs={"a": torch.rand(6), "b": torch.rand(6)}, outputs={"sum": out}, device="cpu")


def test_a_warp_without_the_privates_that_are_read_launches_plainly(monkeypatch):
    @wp.kernel(module="unique")
    def numbered(first: int, x_in: wp.array(dtype=float), y_out: wp.array2d(dtype=float)):
        i, k = wp.tid()
        y_out[first + i, k] = x_in[first + i] + float(k)

    x = torch.rand(100)
    for privates in (("a name that no Warp has",), cached.PRIVATES):
        monkeypatch.setattr(cached, "PRIVATES", privates)
        for chunk, workers in ((32, 2), (200, 1)):
            out = torch.zeros(100, 3)
            launch_trials(
                numbered, 90, inputs={"x": x}, outputs={"y": out}, device="cpu", width=3, first=10, chunk=chunk,
                threads=workers,
            )  # fmt: skip
            expected = torch.where(torch.arange(100)[:, None] >= 10, x[:, None] + torch.arange(3), 0.0)
            assert torch.equal(out, expected)


def test_nobody_is_at_work_once_an_interrupt_has_left_the_call():
    """The caller frees its memory then: who still wrote there would end the process."""
    started, at_work, chunks = threading.Event(), [], []

    def run(worker: int, start: int, rows: int) -> None:
        if worker == 0:
            assert started.wait(10)
            raise KeyboardInterrupt
        at_work.append(start), chunks.append(start)
        started.set()
        time.sleep(0.1)
        at_work.remove(start)

    with pytest.raises(KeyboardInterrupt):
        threads.share(run, 0, 100, 3, 1)
    assert at_work == []
    begun = len(chunks)
    time.sleep(0.2)
    assert len(chunks) == begun <= 4
