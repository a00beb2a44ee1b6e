"""Our own hand written as MANO writes its own: one pickle a side, with chumpy's classes and scipy's sparse matrix in it."""

import pickle
import sys
import types
from pathlib import Path

import numpy as np
import scipy.sparse

from r2h_batch.bodies.hand import load_hand

MIRROR = np.array([-1.0, 1.0, 1.0])
AXIAL = np.array([1.0, -1.0, -1.0])


def mano_dictionary(side=0, *, shift=(0.0957, 0.0064, 0.0062), posedirs=None, faces=None):
    """The built-in hand as arrays of MANO's names: wrist not at the origin, 20 shape directions, joints by regression."""
    hand = load_hand()
    flip = MIRROR if side else np.ones(3)
    vertices = hand.vertices.double().numpy()
    shape = hand.shape_basis.double().numpy()
    joints, joint_shape = hand.joints_rest.double().numpy(), hand.joint_shape_basis.double().numpy()
    count = len(vertices)
    # Joints as weighted vertices, in the rest shape and along all shape directions: 34 equations, many unknowns.
    wanted = np.concatenate([joints[:, :, None], joint_shape], 2).reshape(16, -1)
    given = np.concatenate([vertices[:, :, None], shape], 2).reshape(count, -1)
    given, wanted = np.column_stack([given, np.ones(count)]), np.column_stack([wanted, np.ones(16)])
    regressor = np.linalg.lstsq(given.T, wanted.T, rcond=None)[0].T
    rng = np.random.default_rng(5)
    own_faces = hand.faces.numpy() if faces is None else faces
    return {
        "v_template": (vertices + shift) * flip,
        "f": (own_faces[:, ::-1] if side else own_faces).astype(np.uint32),
        "shapedirs": np.concatenate([shape, rng.normal(0, 1e-3, shape.shape)], 2) * flip[:, None],
        "posedirs": np.zeros((count, 3, 135)) if posedirs is None else posedirs,
        "J_regressor": scipy.sparse.csc_matrix(regressor),
        "J": (joints + shift) * flip,
        "weights": hand.weights.double().numpy(),
        "kintree_table": np.array([[4294967295, *hand.parents[1:]], range(16)], np.uint32),
        "hands_components": np.linalg.qr(rng.normal(size=(45, 45)))[0],
        "hands_mean": rng.normal(0, 0.2, 45) * np.tile(AXIAL if side else np.ones(3), 15),
        "hands_coeffs": rng.normal(size=(20, 45)),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }


def write_mano(path: Path, arrays, protocol=2) -> Path:
    """The pickle, `shapedirs` a `Select` of ten of the twenty directions of a `Ch`, written without chumpy."""
    path.write_bytes(with_fake_chumpy(lambda Ch, Select: {
        **{k: v for k, v in arrays.items() if k != "shapedirs"},
        "shapedirs": Select(
            a=Ch(x=arrays["shapedirs"]), idxs=first_ten(arrays["shapedirs"]),
            preferred_shape=(*arrays["shapedirs"].shape[:2], 10),
        ),
        "v_template": Ch(x=arrays["v_template"]),
    }, protocol))  # fmt: skip
    return path


def first_ten(source):
    return np.arange(source.size).reshape(source.shape)[:, :, :10].ravel()


def with_fake_chumpy(make, protocol=2):
    """A pickle with chumpy's class names in it, written by classes that only exist while it is written."""

    class Stub:
        def __init__(self, **state):
            self.__dict__.update(state)

    modules, classes = {}, []
    for module, name in (("chumpy.ch", "Ch"), ("chumpy.reordering", "Select")):
        made = type(name, (Stub,), {"__module__": module})
        modules[module] = types.ModuleType(module)
        setattr(modules[module], name, made)
        classes.append(made)
    sys.modules.update({"chumpy": types.ModuleType("chumpy"), **modules})
    try:
        return pickle.dumps(make(*classes), protocol)
    finally:
        for module in ("chumpy", *modules):
            del sys.modules[module]
