"""A user's own contact predictor: networks as data, functions of the user's own code, one line for the rest."""

import pickle
import zipfile
from importlib import resources

import pytest
import torch
from needs import needs
from onnx_files import contact_network, expanding_network, looping_network
from safetensors.torch import save_file

from r2h_batch import load_benchmark
from r2h_batch.base.errors import FileError
from r2h_batch.base.io import onnx
from r2h_batch.methods.predictors import load_predictor, predict_contacts
from r2h_batch.methods.predictors.grid import contact_grids
from r2h_batch.methods.predictors.voxnet import load_voxnet
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.scene import Scene
from r2h_batch.sweep import command as sweep

GRID = contact_grids(load_objects(["cup"]))


def refused(path, *parts):
    with pytest.raises(FileError) as error:
        load_predictor(str(path))
    message = str(error.value)
    assert "\n" not in message and all(part in message for part in parts), message


def test_torchscript_is_refused_by_a_line_that_names_onnx_and_trust_code_by_another(tmp_path, capsys):
    with zipfile.ZipFile(tmp_path / "net.pt", "w") as archive:
        archive.writestr("net/constants.pkl", b"")
        archive.writestr("net/code/__torch__.py", b"class Net(Module): ...")
    refused(tmp_path / "net.pt", "r2h_batch 0.3 read TorchScript", "export the network as ONNX (torch.onnx.export)")
    line = ["--benchmark", "r2h-v1", "--method", "contact", "--trials", "1", "--execute.sim", "none"]
    assert sweep.main([*line, "--predictor", str(tmp_path / "net.pt")]) == 2
    assert "export the network as ONNX" in capsys.readouterr().err
    (tmp_path / "mine.yaml").write_text("trust_code: true\n")
    assert sweep.main([*line, "--config", str(tmp_path / "mine.yaml")]) == 2
    assert "mine.yaml: sweep --trust-code: r2h_batch 0.3 had it" in capsys.readouterr().err


@needs("onnxruntime")
def test_an_onnx_network_answers_and_takes_its_weights_from_no_other_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    net = tmp_path / "net.onnx"
    net.write_bytes(contact_network(channel=2))
    assert torch.allclose(load_predictor("net.onnx")(GRID), torch.sigmoid(GRID[:, 2]), atol=1e-6)
    (tmp_path / "weights.bin").write_bytes((2).to_bytes(8, "little"))
    for file in ("weights.bin", "/dev/zero"):
        net.write_bytes(contact_network(file=file))
        refused("net.onnx", "keeps weights in other files")
    net.write_bytes(contact_network(inputs=2))
    refused("net.onnx", "2 inputs and 1 outputs; need one of each")
    for data in (b"", contact_network()[:90], pickle.dumps(1)):
        net.write_bytes(data)
        refused("net.onnx", "not a readable ONNX file", "give an ONNX file")


@needs("onnxruntime")
def test_a_network_that_never_answers_or_takes_all_memory_is_ended(tmp_path, monkeypatch, own_process):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.onnx").write_bytes(expanding_network(1000))
    assert torch.equal(load_predictor("net.onnx")(GRID), GRID)
    # 16 GB: more than the process may take, found when the file is read or when it answers
    (tmp_path / "net.onnx").write_bytes(expanding_network(4 << 30))
    with pytest.raises(FileError, match=r"net.onnx: .*memory"):
        load_predictor("net.onnx")(GRID)
    (tmp_path / "net.onnx").write_bytes(looping_network(1 << 62))
    network = load_predictor("net.onnx")
    monkeypatch.setattr(onnx, "MOST_SECONDS", 2)
    with pytest.raises(FileError, match=r"net.onnx: takes more than 2 s of CPU time"):
        network(GRID)


@needs("onnxruntime")
def test_a_network_of_another_type_is_refused_by_its_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.onnx").write_bytes(looping_network(3))
    assert torch.equal(load_predictor("net.onnx")(GRID), GRID)
    (tmp_path / "net.onnx").write_bytes(looping_network(3, kind=7))
    refused("net.onnx", "its input is a tensor(int64); it must be a tensor(float)")


def test_safetensors_and_a_python_function_take_the_networks_place(tmp_path, monkeypatch):
    scene = Scene(load_benchmark("r2h-v1").with_objects(load_objects(["hammer"])))
    trials = load_benchmark("r2h-v1").with_objects(scene.objects).trials(2, splits=["S1"])
    (tmp_path / "own_contacts.py").write_text("def half(grid):\n    return (grid[:, 1] > 0).float()\n")
    monkeypatch.syspath_prepend(tmp_path)
    found = predict_contacts(trials, scene, predictor=load_predictor("own_contacts:half"))
    x = torch.from_numpy(scene.objects[0].points[:, 0])
    assert torch.equal(found[0][x.abs() > 0.006] == 1, x[x.abs() > 0.006] > 0)
    stored = resources.files("r2h_batch.assets.receiving") / "voxnet.safetensors"
    (tmp_path / "own.safetensors").write_bytes(stored.read_bytes())
    own = load_predictor(str(tmp_path / "own.safetensors"))
    assert torch.equal(predict_contacts(trials, scene, predictor=own), predict_contacts(trials, scene, contacts="all"))
    weights = load_voxnet().state_dict()
    del weights["out.bias"]
    save_file({k: v.contiguous() for k, v in weights.items()}, tmp_path / "less.safetensors")
    refused(tmp_path / "less.safetensors", "weight 'out.bias' is nothing, VoxNet needs (1,)")
    for change, words in (
        (lambda w: w.half(), "is torch.float16, VoxNet needs torch.float32"),
        (lambda w: w * torch.nan, "NaN"),
    ):
        weights = load_voxnet().state_dict()
        weights["out.bias"] = change(weights["out.bias"])
        save_file({k: v.contiguous() for k, v in weights.items()}, tmp_path / "odd.safetensors")
        refused(tmp_path / "odd.safetensors", "weight 'out.bias'", words)


def test_files_that_are_no_network_are_refused_without_being_run(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    (tmp_path / "net.pkl").write_bytes(pickle.dumps(Trap()))
    torch.save({"weight": Trap()}, tmp_path / "net.pt")
    (tmp_path / "net.bin").write_bytes(b"hello")
    (tmp_path / "broken.safetensors").write_bytes(b"hello")
    for name, message in (
        ("net.pkl", "a pickle, which runs code when read; give an ONNX file"),
        ("net.pt", "a file of PyTorch, a program or a pickle, which runs code when read"),
        ("net.bin", "no network that is known here; give an ONNX file"),
        ("broken.safetensors", "not a readable .safetensors file"),
    ):
        refused(tmp_path / name, message)
    assert not (tmp_path / "ran").exists()
