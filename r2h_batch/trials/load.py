"""`load_benchmark`: a benchmark by its name, of a file, or of a function of yours."""

from pathlib import Path

from r2h_batch.base.errors import FileError, UserError, nearest
from r2h_batch.base.gone import gone
from r2h_batch.base.io.progress import busy
from r2h_batch.base.io.read import printable
from r2h_batch.base.registry import DEFAULT_BENCHMARK
from r2h_batch.base.user_code import HOW, load_function, raised
from r2h_batch.base.validate import instance_of
from r2h_batch.strangers import stranger
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.registry import BENCHMARK, named_benchmark
from r2h_batch.trials.yaml_file import read_benchmark


@busy("loading a benchmark")
def load_benchmark(benchmark: str | Path = DEFAULT_BENCHMARK, *, pieces: bool = False) -> Benchmark:
    """A benchmark: one value that holds all that decides a verdict.

    Args:
        benchmark: a name of `r2h-batch ls benchmarks`; a benchmark.yaml, or a folder with one; or a function without
            arguments that returns a `Benchmark`: `package.module:function` or `FILE.py:function`.
        pieces: whether meshes of a file get their convex decomposition (up to a minute each).

    Raises:
        FileError: there is none, or (one line) its file is wrong.
    """
    instance_of((str, Path), "a name, or a benchmark.yaml")("benchmark", benchmark)
    if benchmark in BENCHMARK:
        return named_benchmark(str(benchmark))
    text, path = str(benchmark), Path(benchmark)
    if names_function(text):
        return _of_function(text)
    if _names_file(path):
        return read_benchmark(path / "benchmark.yaml" if path.is_dir() else path, pieces=pieces)
    if told := gone(f"benchmark {text}"):
        raise FileError(told)
    raise FileError(
        f"no benchmark is called {printable(text)[:200]!r}{nearest(text, list(BENCHMARK))}; allowed are"
        f" {', '.join(BENCHMARK)}, a benchmark.yaml, or {HOW}"
    )


def names_function(benchmark: str) -> bool:
    """Whether `load_benchmark` takes this text as a function of the user's, which runs when it is loaded."""
    return benchmark not in BENCHMARK and not _names_file(Path(benchmark)) and ":" in benchmark


def _names_file(path: Path) -> bool:
    return path.suffix.lower() in (".yaml", ".yml") or path.is_dir()


def _of_function(spec: str) -> Benchmark:
    """The benchmark that a user's function returns."""
    try:
        own = load_function(spec)
        if not callable(own.function):
            raise ImportError(f"is a {type(own.function).__name__}, no function")
        with stranger(f"benchmark {printable(spec)}", own.module.__name__):
            found = own.function()
    except ImportError as error:
        raise FileError(
            f"benchmark {printable(spec)}: {printable(error)}; it must be {HOW}"
        ) from None
    except (KeyboardInterrupt, UserError):  # Ctrl-C; a file that the function reads
        raise
    except BaseException as error:  # SystemExit too: it would end the command without a word
        raise FileError(
            f"benchmark {printable(spec)}: {raised(error)}; it must return a Benchmark"
        ) from error
    if not isinstance(found, Benchmark):
        raise FileError(
            f"benchmark {printable(spec)}: returned {type(found).__name__}; it must return a Benchmark"
        )
    return found
