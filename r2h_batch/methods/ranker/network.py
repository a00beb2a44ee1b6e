"""The ranker: a small PointNet on each candidate's cloud, and an MLP on the pair. Its weights are a .safetensors file."""

import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float32
from safetensors import SafetensorError, safe_open
from safetensors.torch import load, save
from torch import Tensor, nn

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable, read_file
from r2h_batch.base.io.write import atomic_path
from r2h_batch.methods.ranker.features import CANDIDATE, CLOUD, PAIR

MAX_BYTES = 1 << 20
"""Largest file of weights."""
WIDTH, CODE, POINT = 192, 96, 48
CUT = 6.0
"""Features count up to so many deviations."""
UNNAMED = ("stability", "plan", "reach", "affordance", "safe")
"""Criteria of a file of weights that names none, as the first that shipped."""
_CRITERIA, _LAST = "criteria", "head.6.bias"
_OTHER = "holds weights of another network"
_GIVE = "give a file that r2h-batch train rank wrote with this version"


class Ranker(nn.Module):
    """Logits of a pair: success first, then each criterion that it learned. Who judges by others may use it as well.

    Args:
        criteria: their names; labels have this order.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, criteria: Sequence[str] = UNNAMED) -> None:
        super().__init__()
        self.criteria = tuple(criteria)
        self.each = nn.Sequential(_linear(CLOUD, POINT), nn.SiLU(), _linear(POINT, CODE))
        numbers = CANDIDATE + PAIR
        self.register_buffer("mean", torch.zeros(numbers, dtype=torch.float32, device="cpu"))
        self.register_buffer("std", torch.ones(numbers, dtype=torch.float32, device="cpu"))
        layers: list[nn.Module] = []
        for wide in (CODE + numbers, WIDTH, WIDTH):
            layers += [_linear(wide, WIDTH), nn.SiLU()]
        self.head = nn.Sequential(*layers, _linear(WIDTH, 1 + len(self.criteria)))

    def code(self, cloud: Float32[Tensor, "*b p 8"]) -> Float32[Tensor, "*b 96"]:
        """A candidate's cloud in 96 numbers.

        Args:
            cloud: of `features.cloud_in_gripper`.
        """
        found: Tensor = self.each(cloud).amax(-2)
        return found

    def forward(
        self,
        code: Float32[Tensor, "*b 96"],
        candidate: Float32[Tensor, "*b 9"],
        pair: Float32[Tensor, "*b 58"],
    ) -> Float32[Tensor, "*b c"]:
        """The logits.

        Args:
            code: of `code`.
            candidate: of `features.of_candidate`.
            pair: of `features.of_pair`.
        """
        x = torch.cat([candidate, pair], -1)
        x = ((x - self.mean) / self.std).clamp(-CUT, CUT)
        found: Tensor = self.head(torch.cat([code, x], -1))
        return found


def _linear(inputs: int, outputs: int) -> nn.Linear:
    """A layer that the caller's defaults of torch do not change."""
    return nn.Linear(inputs, outputs, dtype=torch.float32, device="cpu")


def save_weights(net: Ranker, path: Path, about: Mapping[str, object]) -> None:
    """Write a network's weights, the criteria that it learned, and how they were made.

    Args:
        net: any ranker.
        path: a .safetensors file.
        about: what `about_weights` returns again; JSON.
    """
    weights = {k: v.detach().contiguous() for k, v in net.state_dict().items()}
    told = {**about, _CRITERIA: list(net.criteria)}
    data = save(weights, {"about": json.dumps(told, sort_keys=True)})
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


@lru_cache(maxsize=16)
def read_weights(path: Path) -> Ranker:
    """A ranker with the weights of a .safetensors file.

    Args:
        path: as `save_weights` or `r2h-batch train rank` writes it.

    Raises:
        FileError: no such file, or weights of another network.
    """
    try:
        found = load(read_file(path, MAX_BYTES))
    except SafetensorError as error:
        raise FileError(f"{path}: not a readable .safetensors file ({printable(error)})") from error
    criteria = _told(path).get(_CRITERIA, UNNAMED)
    if not isinstance(criteria, (list, tuple)) or not all(isinstance(c, str) for c in criteria):
        raise FileError(
            f"{path}: {_CRITERIA} is {printable(criteria)[:100]}; it must be a list of names"
        )
    logits = 1 + len(criteria)
    shapes = {k: (v.dtype, v.shape) for k, v in found.items()}
    if (torch.float32, (logits,)) != shapes.get(_LAST):  # before so many outputs are made
        raise FileError(
            f"{path}: {_OTHER}, or of other criteria than {printable(', '.join(criteria))[:200]}; {_GIVE}"
        )
    net = Ranker(criteria)
    if shapes != {k: (v.dtype, v.shape) for k, v in net.state_dict().items()}:
        raise FileError(f"{path}: {_OTHER}; {_GIVE}")
    if not all(bool(v.isfinite().all()) for v in found.values()):
        raise FileError(f"{path}: holds NaN or infinite numbers; train it again, or copy it again")
    net.load_state_dict(found)
    return net.eval()


def about_weights(path: Path) -> dict[str, object]:
    """How weights were made: what `save_weights` was told.

    Args:
        path: a .safetensors file.
    """
    read_weights(path)  # says what is wrong with the file
    return _told(path)


def _told(path: Path) -> dict[str, object]:
    """A readable file tells this about its weights."""
    with safe_open(str(path), framework="pt") as file:
        told = (file.metadata() or {}).get("about", "{}")
    try:
        found = json.loads(told)
    except (ValueError, RecursionError) as error:
        raise FileError(f"{path}: what it says about its weights is no JSON; {_GIVE}") from error
    return found if isinstance(found, dict) else {}
