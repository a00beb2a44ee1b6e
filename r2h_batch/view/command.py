"""The commands `view`, `video` and `strips`. Light until there is work."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from r2h_batch.benchmark.flags import BUILT_IN, BenchmarkFlags
from r2h_batch.command_line import UsageError, call, refuse, tell
from r2h_batch.io.write import check_output_file


def view(
    run: Path,
    /,
    *,
    method: tuple[str, ...] = (),
    trial: int | None = None,
    html: Path | None = None,
    port: int = 8080,
    overwrite: bool = False,
    benchmark: BenchmarkFlags = BUILT_IN,
) -> int:
    """Look at the trials of a run folder in a browser: motion, what a failed plan was asked for,
    margins.

    Args:
        run: run folder of a sweep; what it does not store is computed again.
        method: the method to start with, and one to see beside it; the sweep's word (fc) or the
        table's name. trial: trial id to start with. html: write this trial as one page that opens
        without a server, and end; with two methods, one page of both. port: where the viewer
        listens, on this machine alone; 0: any free port. overwrite: replace a page that is there.
        benchmark: as the sweep had them; none of these where it had the built-in benchmark.
    """

    def work() -> int:
        if len(method) > 2:
            raise UsageError(f"--method names {len(method)} methods; two can be seen side by side")
        if not 0 <= port <= 65535:
            raise UsageError(f"--port is {port}; it must be 0 (any free one) to 65535")
        if html is not None and trial is None:
            raise UsageError("--html needs --trial ID: which one to write")
        if html is not None:
            check_output_file(html, overwrite=overwrite, flag="--html")
        from r2h_batch.benchmark.given import Given
        from r2h_batch.export.stored import Reader

        reader = Reader(run, Given.of(benchmark))
        if html is not None and trial is not None:
            from r2h_batch.view.page import write_page

            print(write_page([reader.trial(trial, m) for m in method or [None]], html))
            return 0
        from r2h_batch.view.server import serve

        serve(reader, list(method), trial, port)
        return 0

    return _answered("view", work)


def video(
    run: Path,
    /,
    *,
    trial: int,
    out: Path,
    method: tuple[str, ...] = (),
    size: tuple[int, int] = (960, 720),
    fps: int = 25,
    overwrite: bool = False,
    benchmark: BenchmarkFlags = BUILT_IN,
) -> int:
    """Film a stored trial (.mp4, .webm, .gif), or draw it as a strip (.png, .jpg); several methods
    beside each other.

    Args:
        run: run folder of a sweep; what it does not store is computed again.
        trial: trial id.
        out: the file to write.
        method: needed where the run holds several; the sweep's word (fc) or the table's name.
        size: width and height of a picture, pixels.
        fps: pictures a second.
        overwrite: replace a film or picture that is there.
        benchmark: as the sweep had them; none of these where it had the built-in benchmark.
    """

    def work() -> int:
        from r2h_batch.benchmark.given import Given
        from r2h_batch.export.stored import Reader
        from r2h_batch.view.video import check_size, write_video

        check_size(out, size, fps)
        check_output_file(out, overwrite=overwrite)
        reader = Reader(run, Given.of(benchmark))
        print(
            write_video([reader.trial(trial, m) for m in method or [None]], out, size=size, fps=fps)
        )
        return 0

    return _answered("video", work)


def strips(
    *,
    trial: int,
    out: Path,
    method: tuple[str, ...] = (),
    predictions: tuple[str, ...] = (),
    preset: Literal["default", "paper"] = "default",
    frames: int = 5,
    overwrite: bool = False,
) -> int:
    """Draw what methods make of one trial: a row of pictures for each, along the motion that was
    executed.

    Args:
        trial: trial id of the protocol.
        out: the picture to write, .png.
        method: methods, as in a sweep.
        predictions: predictions files, as in a sweep.
        preset: default or paper, as in a sweep.
        frames: pictures of each method.
        overwrite: replace a picture that is there.
    """

    def work() -> int:
        if trial < 0:
            raise UsageError(f"--trial is {trial}; it must be 0 or more")
        if frames < 2:
            raise UsageError(f"--frames is {frames}; it must be 2 or more")
        check_output_file(out, overwrite=overwrite, endings=(".png", ".jpg", ".pdf", ".svg"))
        from r2h_batch.scene.offscreen import ready

        ready()
        from r2h_batch.view.strips import write_strips

        for line in write_strips(trial, method, predictions, preset, frames, out):
            print(line)
        return 0

    return _answered("strips", work)


def _answered(name: str, work: Callable[[], int]) -> int:
    """Exit code of a command's work: 2 where it is refused, 1 where this machine cannot do it; one
    line for either."""
    from r2h_batch.scene.offscreen import RenderError

    try:
        return work()
    except (
        UsageError,
        ValueError,
    ) as error:  # ExportError, RunError, FileError, ObjectMeshError, PredictionsError
        return refuse(name, error)
    except RenderError as error:
        return refuse(name, error, 1)
    except KeyboardInterrupt:
        tell(f"{name}: ended")
        return 0


def view_main(
    arguments: Sequence[str] | None = None, *, prog: str = "python -m r2h_batch.view"
) -> int:
    """Exit code: 0 written or looked at, 1 could not write, 2 refused with one line."""
    return call(view, sys.argv[1:] if arguments is None else arguments, prog=prog, name="view")


def video_main(arguments: Sequence[str] | None = None, *, prog: str = "r2h-batch video") -> int:
    """Exit code: 0 written, 1 could not draw or write, 2 refused with one line."""
    return call(video, sys.argv[1:] if arguments is None else arguments, prog=prog, name="video")


def strips_main(arguments: Sequence[str] | None = None, *, prog: str = "r2h-batch strips") -> int:
    """Exit code: 0 written, 1 could not draw or write, 2 refused with one line."""
    return call(strips, sys.argv[1:] if arguments is None else arguments, prog=prog, name="strips")
