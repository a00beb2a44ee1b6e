"""Our own hand written as MANO is released: one pickle a side, with chumpy's classes (their sets and caches too) and scipy's
sparse matrix in it; and MANO's own formula."""

import pickle
import sys
import types
from pathlib import Path

import numpy as np
import scipy.sparse
from scipy.spatial.transform import Rotation

from r2h_batch.scene.hand import load_hand

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


def mano_twin(arrays, pose, shape):
    """MANO's own formula in its file's own coordinates (Romero et al. 2017, eq. 2 to 4), one hand, float64."""
    rest = arrays["v_template"] + arrays["shapedirs"][:, :, :10] @ shape
    joints = arrays["J_regressor"] @ rest
    turns = Rotation.from_rotvec(pose.reshape(16, 3)).as_matrix()
    skin = rest + arrays["posedirs"] @ (turns[1:] - np.eye(3)).ravel()
    world = np.zeros((16, 4, 4))
    for j, parent in enumerate((-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)):
        T = np.eye(4)
        T[:3, :3] = turns[j]
        T[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0)
        world[j] = T if parent < 0 else world[parent] @ T
    out = np.zeros_like(skin)
    for j in range(16):
        moved = (skin - joints[j]) @ world[j, :3, :3].T + world[j, :3, 3]
        out += arrays["weights"][:, j, None] * moved
    return out, world[:, :3, 3]


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
            # what `Ch.__getstate__` keeps: its terms, and sets of names beside them
            cached = {"deps": {"x", "a"}, "value": None, "out_of_date": True}
            self.__dict__.update({"_dirty_vars": set(state), "_itr": None, "_depends_on_deps": {"r": cached}}, **state)

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
