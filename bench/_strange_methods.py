"""Methods, policies and seeds of strangers: code that is asked for answers, and may not change anybody's verdict."""

import importlib
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from _attack import SHORT_SWEEP, TAG, Attack, Command, Ended, Place, small
from _strange_answers import digest, expected, nothing_passed, poses

ANSWER = """
import os
import numpy as np
import torch

_G = torch.tensor(np.load({place!r})["T_obj_ee"])
_H = torch.tensor(np.load({place!r})["T_world_ee"])


def answer(trials):
    rows = trials.trial_id.long()
    return _G[rows].clone(), _H[rows].clone()

"""
"""A method that answers as the oracle did, so that a verdict which another one has moved shows itself."""
SWEEP = [*SHORT_SWEEP, "--method", "mine=mine.py:predict", "--out", "run"]


def method(
    code: str,
    *commands: Command,
    must: str = "either",
    then: Callable[[Place, Ended], str] | None = None,
    words: Sequence[str] = SWEEP,
) -> Attack:
    """A sweep of a stranger's method."""

    def does(place: Place) -> list[Command]:
        own = poses()
        order = np.argsort(own["trial_id"])
        np.savez(place.work / "own.npz", T_obj_ee=own["T_obj_ee"][order], T_world_ee=own["T_world_ee"][order])
        text = ANSWER.format(place=str(place.work / "own.npz")) + code
        (place.work / "mine.py").write_text(text.replace("OUTSIDE", str(place.outside)))
        return [words, *commands]

    return Attack(does, must, then or same)


def same(place: Place, ended: Ended) -> str:
    """The rows are those of the sound answers, or there are none."""
    if ended.how != "read" or not (place.work / "run" / "run.json").exists():
        return ""
    return "" if digest(place) == expected() else "another verdict"


def leaves(before: str = "", after: str = "") -> Attack:
    """A method that answers soundly and leaves something changed in its process."""
    return method(
        f"def predict(trials, scene):\n    {before or 'pass'}\n    found = answer(trials)\n"
        f"    {after or 'pass'}\n    return found\n"
    )


STATE: dict[str, Attack] = {
    "numbers are rounded up": leaves(after="import ctypes; ctypes.CDLL(None).fesetround(0x800)"),
    "subnormal numbers are zero": leaves(after="torch.set_flush_denormal(True)"),
    "products of matrices are rough": leaves(after="torch.set_float32_matmul_precision('medium')"),
    "any order of sums": leaves(
        after="torch.use_deterministic_algorithms(False); torch.backends.mkldnn.enabled = False"
    ),
    "one thread": leaves(after="torch.set_num_threads(1)"),
    "99 threads": leaves(after="torch.set_num_threads(99)"),
    "floats of 8 bytes by default": leaves(after="torch.set_default_dtype(torch.float64)"),
    "the device of nothing by default": leaves(after="torch.set_default_device('meta')"),
    "warnings are errors": leaves(after="import warnings; warnings.simplefilter('error')"),
    "NumPy raises": leaves(after="np.seterr(all='raise')"),
    "another folder": leaves(after="os.chdir('/')"),
    "another mask of modes": leaves(after="os.umask(0o777)"),
    "another tongue": leaves(after="import locale; locale.setlocale(locale.LC_ALL, 'C')"),
    "a recursion of 60": leaves(
        after="import sys; sys.setrecursionlimit(max(60, len(__import__('inspect').stack()) + 30))"
    ),
    "nothing is collected": leaves(after="import gc; gc.disable(); gc.freeze()"),
    "a tracer": leaves(
        after="import sys, threading; sys.settrace(lambda *a: None); threading.settrace(lambda *a: None)"
    ),
    "a profile that raises": leaves(after="import sys; sys.setprofile(lambda *a: None)"),
    "SIGTERM is nobody's": leaves(
        after="import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); signal.alarm(0)"
    ),
    "no more files": leaves(after="import resource; resource.setrlimit(resource.RLIMIT_NOFILE, (20, 20))"),
    "no file may grow": leaves(
        after="import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        " resource.setrlimit(resource.RLIMIT_FSIZE, (10, 10))"
    ),
    "no grad, and inference for ever": leaves(
        after="torch.set_grad_enabled(False); torch.inference_mode(True).__enter__()"
    ),
    "Warp's fast mathematics": leaves(after="import warp; warp.config.fast_math = True; warp.config.mode = 'debug'"),
    "Warp checks nothing": leaves(after="import warp; warp.config.verify_fp = True; warp.config.print_launches = True"),
    "the same seed for all": leaves(after="import random; random.seed(0); np.random.seed(0); torch.manual_seed(0)"),
    "the environment is another": leaves(after="os.environ.clear(); os.environ['R2H_BATCH_CACHE'] = 'OUTSIDE/folder'"),
    "a child that stays": leaves(after="__import__('subprocess').Popen(['sleep', '30'])"),
    "a thread that stays": leaves(
        after="__import__('threading').Thread(target=__import__('time').sleep, args=(30,)).start()"
    ),
    "a thread that changes the answer afterwards": leaves(
        after="import threading, time; t = found[1].numpy(); rest = range(2000);"
        " late = lambda: [(time.sleep(0.001), t.__setitem__(slice(None), 0)) for _ in rest];"
        " threading.Thread(target=late, daemon=True).start()"
    ),
    "its trials are turned": leaves(after="trials.T_world_hand[...] = torch.eye(4)"),
    "its scene is empty": leaves(
        after="[setattr(scene, k, None) for k in list(vars(scene)) if hasattr(scene, '__dict__')]"
    ),
    "Python's own functions": leaves(
        after="import builtins; builtins.sorted = lambda *a, **k: []; builtins.len = lambda x: 0"
    ),
}
PATCHES: dict[str, str] = {
    "every Evaluator that gc finds": """
    import gc
    for one in gc.get_objects():
        if type(one).__name__ == "Evaluator":
            one.score = lambda *a, **k: (_ for _ in ()).throw(RuntimeError("mine"))
            vars(type(one))
""",
    "the thresholds that gc finds": """
    import gc
    for one in gc.get_objects():
        if type(one).__name__ == "Thresholds":
            object.__setattr__(one, "reach_radius_m", 9.0)
            object.__setattr__(one, "w_max_m", 9.0)
""",
    "the caller's variables": """
    import inspect
    for frame in inspect.stack():
        for name, value in frame.frame.f_locals.items():
            if name in ("evaluator", "scene", "trials", "self") and hasattr(value, "__dict__"):
                vars(value)["mine"] = 1
""",
    "Warp's launches": """
    import warp
    warp.launch = lambda *a, **k: None
""",
    "the table of Parquet": """
    import pyarrow.parquet as pq
    write = pq.write_table
    def forged(table, *a, **k):
        import pyarrow as pa
        if "outcome" in table.column_names:
            i = table.column_names.index("outcome")
            about, won = table.schema.metadata, pa.array(["success"] * len(table))
            table = table.set_column(i, "outcome", won).replace_schema_metadata(about)
        return write(table, *a, **k)
    pq.write_table = forged
""",
    "its memory by /proc/self/mem": """
    with open("/proc/self/maps") as file:
        file.read()
    with open("/proc/self/mem", "rb") as file:
        pass
""",
}


def patched(code: str) -> Attack:
    """A method that gives random poses and changes its process; its rows are judged again by another process."""
    text = f"def predict(trials, scene):\n{code}\n    G, H = answer(trials)\n    H[:, 0, 3] += 0.5\n    return G, H\n"

    def honest(place: Place, ended: Ended) -> str:
        won = nothing_passed(place, ended._replace(how="read")) if (place.work / "run" / "shards").exists() else ""
        return f"{won} after reevaluate" if won and ended.how == "read" else ""

    return method(text, ["results", "reevaluate", "run", "--rows", "6"], then=honest)


ENDS: dict[str, str] = {
    "it raises with an escape": "raise ValueError('a\\x1b[2J\\nb: c\\u202e')",
    "it raises 64 MiB": "raise ValueError('x' * (64 << 20))",
    "its error cannot be printed": "raise type('E', (Exception,), {'__str__': lambda s: 1 / 0})()",
    "its error is a base one": "raise type('E', (BaseException,), {})('x')",
    "it raises KeyboardInterrupt": "raise KeyboardInterrupt",
    "it raises GeneratorExit": "raise GeneratorExit",
    "it raises MemoryError": "raise MemoryError",
    "it recurses for ever": "return predict(trials, scene)",
    "its error causes itself": "e = ValueError('x'); e.__cause__ = e; raise e",
    "it ends the process": "os._exit(0)",
    "it kills itself": "os.kill(os.getpid(), 9)",
    "it forks": "os.fork(); return answer(trials)",
    "it closes every file": "os.closerange(3, 256); return answer(trials)",
    "it answers with itself": "return predict, predict",
    "it answers without end": "return ((answer(trials)[0] for _ in iter(int, 1)), 1)",
    "it answers one row": "G, H = answer(trials); return G[:1], H[:1]",
    "it answers by broadcasting": "G, H = answer(trials); return G[:1].expand(len(G), 4, 4), H",
    "it answers in another order": "G, H = answer(trials); return G.flip(0), H.flip(0)",
    "it answers with gradients": "G, H = answer(trials); return G.requires_grad_(), H",
    "it answers in complex numbers": "G, H = answer(trials); return G + 0j, H",
    "it answers with a liar's array": "G, H = answer(trials); lie = lambda s, *a, **k: 1 / 0;"
    " return type('A', (), {'__array__': lie, 'shape': (6, 4, 4)})(), H",
    "it answers with a liar's tensor": "G, H = answer(trials)\n    class T(torch.Tensor):\n        @classmethod\n"
    "        def __torch_function__(cls, f, types, args=(), kwargs=None):\n            return 1\n"
    "    return G.as_subclass(T), H",
    "it answers in shared memory": "G, H = answer(trials); return G.share_memory_(), H",
    "its time is below 0": "G, H = answer(trials); return G, H, -torch.ones(len(G))",
    "its time is a NaN": "G, H = answer(trials); return G, H, torch.full((len(G),), float('nan'))",
    "its answer depends on the call": "G, H = answer(trials); predict.n = getattr(predict, 'n', 0) + 1;"
    " H[:, 0, 3] += predict.n; return G, H",
    "it writes into the run": "import pathlib\n    for f in pathlib.Path('run').rglob('*.json'):\n"
    "        f.write_text('{}')\n    return answer(trials)",
    "it removes the run": "import shutil; shutil.rmtree('run', ignore_errors=True); return answer(trials)",
    "it prints 64 MiB": "print('x' * (64 << 20)); return answer(trials)",
    "it prints escapes": "print('\\x1b]0;x\\x07'); return answer(trials)",
    "it warns with escapes": "import warnings; warnings.warn('a\\x1b[2J\\nb'); return answer(trials)",
}
NOT_SAME = (
    "it answers by broadcasting",
    "it answers in another order",
    "its answer depends on the call",
    "it writes into the run",
    "it removes the run",
    "it forks",
)
HEADS: dict[str, str] = {
    "it learned from a tag": f"TRAINED_ON = ({TAG!r},)",
    "it learned from everything": "TRAINED_ON = ('*',)",
    "it learned from a pattern that takes for ever": "TRAINED_ON = ('*a' * 40 + 'b',)",
    "it learned from a million patterns": "TRAINED_ON = tuple(f'x{k}_*' for k in range(1_000_000))",
    "it learned from numbers": "TRAINED_ON = (1, None)",
    "it learned without end": "TRAINED_ON = iter(int, 1)",
    "what it learned from raises": "def TRAINED_ON(**k):\n    raise SystemExit('x\\x1b[2J')",
    "its files are /": "METHOD_FILES = ('/',)",
    "its files are /proc": "METHOD_FILES = ('/proc',)",
    "its file is /dev/zero": "METHOD_FILES = ('/dev/zero',)",
    "its file is a pipe": "os.mkfifo('pipe')\nMETHOD_FILES = ('pipe',)",
    "its files are links in a circle": "os.symlink('loop', 'loop')\nMETHOD_FILES = ('loop',)",
    "its files hold a folder in itself": "os.mkdir('in')\nos.symlink('..', 'in/up')\nMETHOD_FILES = ('in',)",
    "its files are numbers": "METHOD_FILES = (1,)",
    "its file is a secret": "METHOD_FILES = ('../outside/secret.txt',)",
    "its file has 1 TiB without bytes": "open('big', 'wb').truncate(1 << 40)\nMETHOD_FILES = ('big',)",
    "it ends when it is imported": "raise SystemExit(0)",
    "it waits at a prompt when it is imported": "input('password: ')",
    "it takes the name of the package": "import sys, types\nsys.modules['r2h_batch.judge'] = types.ModuleType('x')",
}
SEES = [
    "sweep",
    "--method",
    "mine=mine.py:predict",
    "--sees",
    "cell-v1",
    "--trials",
    "1",
    "--sim",
    "none",
    "--out",
    "run",
]
SEEN: dict[str, str] = {
    "it ends with a code": "os._exit(3)",
    "it closes its pipes": "os.closerange(0, 256)",
    "it writes a pickle into every pipe": "[_try(fd) for fd in range(3, 64)]",
    "it writes 16 MiB into every pipe": "[_try(fd, b'\\xff' * (16 << 20)) for fd in range(3, 64)]",
    "it ends with words": "print('x' * 100_000); raise SystemExit('a\\x1b[2J')",
    "it imports the judge": "import r2h_batch.judge.grasp, r2h_batch.evaluate, r2h_batch.scene",
    "it looks for its parent's words": ""
    "open(f'/proc/{os.getppid()}/environ').read(), open(f'/proc/{os.getppid()}/cmdline').read()",
    "it answers 10^9 rows": "return np.zeros((10**9, 4, 4), np.float32)[:0], 1",
}
WRITE = """
import pickle
import signal


class _Call:
    def __reduce__(self):
        return eval, ("open({outside!r} + '/owned', 'w')",)


def _try(fd, data=None):
    signal.setitimer(signal.ITIMER_REAL, 5)
    try:
        os.set_blocking(fd, False)
        os.write(fd, pickle.dumps(_Call()) if data is None else data)
    except (OSError, ValueError):
        pass

"""


def seen(body: str) -> Attack:
    """A method that sees: it runs in a process of its own."""

    def does(place: Place) -> list[Command]:
        head = "import os\nimport numpy as np\n" + WRITE.format(outside=str(place.outside)).replace(
            "{outside!r}", repr(str(place.outside))
        )
        answer = "    n = len(seen.key)\n    T = np.tile(np.eye(4, dtype=np.float32), (n, 1, 1))\n    return T, T\n"
        (place.work / "mine.py").write_text(f"{head}def predict(seen, *, seed=0):\n    {body}\n{answer}")
        return [SEES]

    return Attack(does, "either", nothing_passed)


# ---- policies, environments, functions: what Python takes


def called(make: Callable[[], object], must: str = "refused") -> Attack:
    """A call in Python."""
    return Attack(lambda place: [make], must)


def env(seed: Any) -> Callable[[], object]:
    """An environment that begins with this seed."""

    def call() -> None:
        import gymnasium

        import r2h_batch
        from r2h_batch.base.errors import UserError

        importlib.reload(r2h_batch)  # it registers the environment where gymnasium is imported before it

        envs = gymnasium.make_vec(
            "r2h_batch/Handover-v1", num_envs=2, method="random", motion="moves", benchmark="r2h-v1"
        )
        try:
            envs.reset(seed=seed)
        except (ValueError, TypeError, OverflowError) as error:
            raise UserError(str(error)) from error

    return call


SEEDS: dict[str, Any] = {
    "-1": -1,
    "2^200": 2**200,
    "1.5": 1.5,
    "NaN": float("nan"),
    "a word": "0",
    "true": True,
    "three for two": [1, 2, 3],
    "none for two": [],
    "lists in a list": [[1], [2]],
    "a word of two": "12",
    "floats": [1.0, 2.0],
}

KINDS = {
    "what a method leaves behind": STATE,
    "what a method patches": {k: patched(v) for k, v in PATCHES.items()},
    "how a method ends": {
        k: method(f"def predict(trials, scene):\n    {v}\n", then=(lambda p, e: "") if k in NOT_SAME else None)
        for k, v in ENDS.items()
    },
    "what a method says of itself": {
        k: method(f"{v}\n\ndef predict(trials, scene):\n    return answer(trials)\n", then=None)
        for k, v in HEADS.items()
    },
    "methods that see": {k: seen(v) for k, v in SEEN.items()},
    "seeds of an environment": {k: called(env(v)) for k, v in SEEDS.items()},
}
_ = (os, small)
