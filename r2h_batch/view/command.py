"""The command `view`: trials in a browser, as a page, a film or strips. Imports little until it
knows what to do."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from r2h_batch.benchmark.flags import BUILT_IN, BenchmarkFlags
from r2h_batch.command_line import UsageError, call, check_range, refuse, tell
from r2h_batch.io.write import check_output_file

FILMS = (".mp4", ".webm", ".gif")
STRIPS = (".png", ".jpg", ".jpeg", ".pdf", ".svg")
LARGEST = (1920, 1080)


def view(
    run: Path | None = None,
    /,
    *,
    method: tuple[str, ...] = (),
    trial: int | None = None,
    html: Path | None = None,
    video: Path | None = None,
    strips: Path | None = None,
    size: tuple[int, int] | None = None,
    frames: int = 5,
    fps: int = 25,
    predictions: tuple[str, ...] = (),
    preset: Literal["default", "paper", "release"] = "default",
    port: int = 8080,
    overwrite: bool = False,
    benchmark: BenchmarkFlags = BUILT_IN,
) -> int:
    """Look at the trials of a run folder in a browser, or write one as a page, a film or strips.

    Args:
        run: run folder of a sweep; what it does not store is computed again. --strips works without
            one: it asks the methods and judges their answers.
        method: the sweep's word (fc) or the table's name; needed where the run has several. The
            browser and a page show two side by side.
        trial: trial id to show, or to start with in the browser.
        html: write the trial as one page that opens without a server.
        video: write the trial as a film (.mp4, .webm, .gif), methods beside each other.
        strips: write the trial as pictures along its motion (.png, .jpg, .pdf, .svg), a row for
            each method.
        size: width and height of one picture in pixels; 960 720 in films, 480 400 in strips.
        frames: strips: pictures of each method.
        fps: films: pictures a second.
        predictions: strips without a run folder: predictions files, as in a sweep.
        preset: strips without a run folder: as in a sweep.
        port: where the browser finds the viewer, on this machine alone; 0: any free one.
        overwrite: replace files that are there.
        benchmark: as the sweep had them; none of these where it had the built-in benchmark.
    """
    from r2h_batch.scene.offscreen import RenderError, ready

    try:
        _check(run, method, trial, html, video, strips, size, frames, fps, predictions, port)
        outputs: Any = ((html, "--html", ()), (video, "--video", FILMS))
        for file, flag, endings in (*outputs, (strips, "--strips", STRIPS)):
            if file is not None:
                check_output_file(file, overwrite=overwrite, flag=flag, endings=endings)
        if video or strips:
            ready()
        if run is None:
            assert strips is not None and trial is not None
            shown = _answers(trial, method, predictions, preset)
        else:
            from r2h_batch.benchmark.build import BenchmarkOverrides
            from r2h_batch.export.stored import Reader

            reader = Reader(run, BenchmarkOverrides.of(benchmark))
            if trial is None or not (html or video or strips):
                from r2h_batch.view.server import serve

                serve(reader, list(method), trial, port)
                return 0
            shown = [reader.trial(trial, m) for m in method or [None]]
        _write(shown, html, video, strips, size, frames, fps)
    except (UsageError, ValueError) as error:
        return refuse("view", error)
    except RenderError as error:
        return refuse("view", error, 1)
    except KeyboardInterrupt:
        tell("view: ended")
    return 0


def _check(
    run: Path | None, method: Sequence[str], trial: int | None, html: Path | None,
    video: Path | None, strips: Path | None, size: tuple[int, int] | None, frames: int, fps: int,
    predictions: Sequence[str], port: int,
) -> None:  # fmt: skip
    """Refuses what cannot be shown before anything slow starts: raises `UsageError`."""
    if run is None and (strips is None or html or video):
        raise UsageError("name a run folder; without one only --strips FILE can be written")
    if run is not None and predictions:
        raise UsageError("--predictions is for --strips without a run folder")
    for flag, file in (("--html", html), ("--video", video), ("--strips", strips)):
        if file is not None and trial is None:
            raise UsageError(f"{flag} needs --trial ID: which one to write")
    if trial is not None and trial < 0:
        raise UsageError(f"--trial is {trial}; it must be 0 or more")
    if len(method) > 2 and not (video or strips):
        raise UsageError(f"--method names {len(method)} methods; two can be seen side by side")
    check_range("--port", port, 0, 65535, "; 0 takes any free one")
    check_range("--frames", frames, 2, 50)
    check_range("--fps", fps, 1, 60)
    if size is not None and not all(
        16 <= s <= most and s % 2 == 0 for s, most in zip(size, LARGEST, strict=True)
    ):
        allowed = f"even numbers from 16 to {LARGEST[0]} and {LARGEST[1]}"
        raise UsageError(f"--size is {size[0]} {size[1]}; it must be {allowed}")


def _answers(trial_id: int, methods: Sequence[str], files: Sequence[str], preset: str) -> list[Any]:
    """What methods and predictions files make of one trial, judged (`StoredTrial`s)."""
    import torch

    from r2h_batch.export.stored import judged_again
    from r2h_batch.sweep.jobs import load_files, make_jobs, prepare
    from r2h_batch.sweep.options import Options, check
    from r2h_batch.types import Predictions

    plan: Any = {"preset": preset, "trials": max(500, trial_id // 2 + 1), "allow_missing": True}
    options = check(Options(method=tuple(methods), predictions=tuple(files), **plan))
    bench = prepare(options)
    ids = torch.tensor([trial_id], dtype=torch.int64, device="cpu")
    trial, place = bench.trials(ids), int(torch.nonzero(bench.ids(0, bench.planned) == trial_id)[0])
    found = []
    for job in make_jobs(options, load_files(options), bench):
        row = None if job.rows is None else job.rows[place : place + 1]
        if row is not None and int(row[0]) < 0:
            tell(f"view: {job.name} has no answer to trial {trial_id}")
            continue
        p = job.predict(trial, row)
        answer = Predictions(p.trial_id, p.T_obj_ee, p.T_world_ee, method=job.name)
        found.append(judged_again(bench.evaluator, trial, answer, job.name))
    if not found:
        raise UsageError(f"no method and no predictions file has an answer to trial {trial_id}")
    return found


def _write(
    shown: Sequence[Any], html: Path | None, video: Path | None, strips: Path | None,
    size: tuple[int, int] | None, frames: int, fps: int,
) -> None:  # fmt: skip
    """Writes the trials and prints where."""
    if html is not None:
        from r2h_batch.view.page import write_page

        print(write_page(shown, html))
    if video is None and strips is None:
        return
    from r2h_batch.export.captions import headline
    from r2h_batch.export.drawing import Drawing
    from r2h_batch.export.pictures import write_film, write_strips

    drawings = [Drawing(s) for s in shown]
    if video is not None:
        write_film(drawings, video, size=size or (960, 720), fps=fps)
        print(video)
    if strips is not None:
        write_strips(drawings, strips, n=frames, size=size or (480, 400))
        for s in shown:
            print(f"{s.method}: {headline(s.row)}")
        print(strips)


def view_main(
    arguments: Sequence[str] | None = None, *, prog: str = "python -m r2h_batch.view"
) -> int:
    """Exit code: 0 written or looked at, 1 could not write, 2 refused with one line."""
    return call(view, sys.argv[1:] if arguments is None else arguments, prog=prog, name="view")


def _alias(name: str, arguments: Sequence[str], prog: str) -> int:
    """`video` and `strips` of version 0.1: `view` with the file under another flag."""
    words, flag = list(arguments), f"--{name}"
    for k, word in enumerate(words):
        if word == "--out" or word.startswith("--out="):
            file = word.partition("=")[2] or (words[k + 1] if k + 1 < len(words) else "")
            flag = "--strips" if Path(file).suffix.lower() in STRIPS else flag
            words[k] = flag + word[5:]
    tell(
        f"{name}: this is now `r2h-batch view` with {flag} FILE; the old name goes with the next version"
    )
    return view_main(words, prog=prog)


def video_main(arguments: Sequence[str] | None = None, *, prog: str = "r2h-batch video") -> int:
    """The former name of `view --video`."""
    return _alias("video", sys.argv[1:] if arguments is None else arguments, prog)


def strips_main(arguments: Sequence[str] | None = None, *, prog: str = "r2h-batch strips") -> int:
    """The former name of `view --strips`."""
    return _alias("strips", sys.argv[1:] if arguments is None else arguments, prog)
