"""Predictions files made by hand, good and bad, and how a bad one is refused."""

import io
import warnings
import zipfile

import numpy as np
import pytest

from r2h_batch.base.errors import FileError
from r2h_batch.trials.predictions import load_predictions


def arrays(n: int = 5, **changes) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(2)
    data = {
        "trial_id": np.arange(n),
        "T_obj_ee": rng.normal(size=(n, 4, 4)).astype(np.float32),
        "T_world_ee": rng.normal(size=(n, 4, 4)).astype(np.float32),
    }
    return {k: v for k, v in {**data, **changes}.items() if v is not None}


def store(path, data, method=None):
    np.savez(path, **data, **({} if method is None else {"method": np.array(method)}))
    return path


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array), allow_pickle=True)
    return buffer.getvalue()


def zipped(path, members, compression=zipfile.ZIP_STORED):
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", compression) as archive:
        warnings.simplefilter("ignore")  # duplicate names are on purpose
        for name, data in members:
            archive.writestr(name, data)
    return path


def members(**changes):
    return [(f"{k}.npy", npy(v)) for k, v in arrays(**changes).items()]


def refused(path, *parts) -> str:
    """The message; it is one line, names the file and has every part."""
    with pytest.raises(FileError) as error:
        load_predictions(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    for part in parts:
        assert part in message, message
    return message


# --- what is accepted -----------------------------------------------------------------------------------------------
