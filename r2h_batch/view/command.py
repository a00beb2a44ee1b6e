"""The command `view`: trials in a browser, as a page, a film or strips. Imports little until it
knows what to do."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from r2h_batch.base.command_line import check_range
from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.write import check_output_file
from r2h_batch.verdicts import SPLITS

FILMS = (".mp4", ".webm", ".gif")
STRIPS = (".png", ".jpg", ".jpeg", ".pdf", ".svg")
LARGEST = (1920, 1080)


def view(
    run: Path,
    /,
    *,
    method: tuple[str, ...] = (),
    trial: int | None = None,
    one_of_each: bool = False,
    html: Path | None = None,
    video: Path | None = None,
    strips: Path | None = None,
    sees: Path | None = None,
    rig: str = "cell-v1",
    noise: float = 1.0,
    labels: Literal["exact", "eroded", "grown", "missed"] = "exact",
    size: tuple[int, int] | None = None,
    frames: int = 5,
    fps: int = 25,
    port: int = 8080,
    receiver_motion: str = "",
    policy: str = "planned",
    overwrite: bool = False,
    code: tuple[str, ...] = (),
) -> int:
    """Look at the trials of a run folder in a browser, or write one as a page, a film or strips.

    Args:
        run: run folder of a sweep; what it does not store is computed again.
        method: the sweep's word (fc) or the table's name; needed if the run has several methods. The browser
            and a page show two side by side.
        trial: trial id to show, or to start with in the browser.
        one_of_each: the first failure of each kind, of the first method. The browser lists these alone; a page, film
            or strips is written for each, with the kind in its name.
        html: write the trial as one page that opens without a server.
        video: write the trial as a film (.mp4, .webm, .gif), methods beside each other.
        strips: write the trial as pictures along its motion (.png, .jpg, .pdf, .svg), a row for
            each method.
        sees: write what depth cameras see of the trial before the robot moves (.png, .jpg, .pdf, .svg).
        rig: sees: the cameras; a name, or a TOML file.
        noise: sees: factor on the errors of the cameras, 0 (none) to 5.
        labels: sees: errors of the masks of object and hand.
        size: width and height of one picture in pixels; 960 720 in films, 480 400 in strips.
        frames: strips: pictures of each method.
        fps: films: pictures a second.
        port: port of the viewer, on this machine alone; 0: any free one.
        receiver_motion: films, strips: play the trial in closed loop, with a hand that moves as in
            `sweep`.
        policy: closed loop: the policy that moves the arm, as in `sweep`.
        overwrite: replace files that are there.
        code: functions of your benchmark or families that the run names and that may run, such as FILE.py:function.
    """
    if sees is not None:
        if trial is None or html or video or strips or one_of_each or method:
            raise UsageError(
                "--sees needs --trial ID, and no method or other output: cameras see the trial before any method"
            )
        check_range("--noise", noise, 0, 5)
        how = {"noise": noise, "labels": labels}
        return _sees(run, trial, rig, sees, code, overwrite=overwrite, how=how)
    if rig != "cell-v1":
        raise UsageError("--rig names the cameras of --sees; add --sees FILE.png")
    if noise != 1 or labels != "exact":
        raise UsageError("--noise and --labels are errors of --sees; add --sees FILE.png")
    outputs: Any = ((html, "--html", ()), (video, "--video", FILMS), (strips, "--strips", STRIPS))
    pictures = bool(video or strips)
    for file, flag, _ in outputs:
        if file is not None and trial is None and not one_of_each:
            raise UsageError(f"{flag} needs --trial ID or --one-of-each: which one to write")
    if one_of_each and (trial is not None or receiver_motion):
        other = "--receiver-motion" if trial is None else "--trial"
        raise UsageError(f"--one-of-each chooses the trials of what was stored; leave out {other}")
    if trial is not None and trial < 0:
        raise UsageError(f"--trial is {trial}; it must be 0 or more")
    if len(method) > 2 and not pictures:
        raise UsageError(f"--method names {len(method)} methods; two can be seen side by side")
    check_range("--port", port, 0, 65535, "; 0 takes any free one")
    check_range("--frames", frames, 2, 50)
    check_range("--fps", fps, 1, 60)
    for length, most in zip(size or (), LARGEST, strict=False):
        if not 16 <= length <= most or length % 2:
            allowed = f"even numbers from 16 to {LARGEST[0]} and {LARGEST[1]}"
            raise UsageError(f"--size is {' '.join(map(str, size or ()))}; it must be {allowed}")
    if receiver_motion and (html or not pictures):
        raise UsageError("--receiver-motion is played in --video and --strips; give one of them")
    if receiver_motion and find_spec("gymnasium") is None:
        raise UsageError("--receiver-motion needs gymnasium: pip install 'r2h_batch[env]'")
    for file, flag, endings in outputs:
        if file is not None and not one_of_each:
            check_output_file(file, overwrite=overwrite, flag=flag, endings=endings)
    from r2h_batch.runs.store import load_run

    stored = load_run(run)  # what is not there is told before torch is imported
    browser = not (html or pictures)
    words = method or (stored.methods[:1] if browser else ())
    if trial is not None:
        stored.holding(trial, words, judged=not browser)
    else:
        for word in words:
            stored.complete(word)
    if pictures:
        from r2h_batch.scene.offscreen import ready

        ready()
    from r2h_batch.view.stored import Reader

    reader = Reader(stored, code)
    only: list[int] | None = None
    if one_of_each:
        from r2h_batch.view.stored import one_failure_of_each

        name = reader.method(method[0] if method else reader.run.methods[0])
        kinds = one_failure_of_each(reader.rows(name).to_pylist())
        if not kinds:
            raise UsageError(f"no trial of {name!r} failed: there is no failure to look at")
        if html or pictures:
            for kind, failed in kinds.items():
                files: dict[str, Any] = {
                    flag[2:]: file.with_stem(f"{file.stem}-{kind}")
                    for file, flag, _ in outputs
                    if file is not None
                }
                view(
                    run, method=(name,), trial=failed, size=size, frames=frames, fps=fps, overwrite=overwrite,
                    code=code, **files,
                )  # fmt: skip
            return 0
        method, only = (name,), list(kinds.values())
    if trial is None or not (html or pictures):
        from r2h_batch.view.server import serve

        serve(reader, list(method), trial, port, only)
        return 0
    drawings: list[Any] = []
    if receiver_motion:
        from r2h_batch.view.episode import episode_of

        try:
            for m in method or [None]:
                drawings.append(episode_of(reader, trial, m, receiver_motion, policy))
        except (ValueError, ImportError) as error:
            raise UsageError(str(error)) from None
        for drawing in drawings:
            print(f"{drawing.stored.method}: {drawing.ended[0]}")
    else:
        shown = [reader.trial(trial, m) for m in method or [None]]
        if html is not None:
            from r2h_batch.view.page import write_page

            print(write_page(shown, html))
        if not pictures:
            return 0
        from r2h_batch.view.captions import verdict_of
        from r2h_batch.view.drawing import Drawing

        for s in shown if strips is not None else ():
            print(f"{s.method}: {verdict_of(s)}")
        drawings += map(Drawing, shown)
    if video is not None:
        from r2h_batch.view.film import Story, write_film
        from r2h_batch.view.whole import story_of

        wide = size or (960, 720)
        whole = "asks" in reader.run.header and not receiver_motion
        stories = [story_of(reader, d, fps) if whole else Story(d) for d in drawings]
        write_film(stories, video, size=wide, fps=fps)
        print(video)
    if strips is not None:
        from r2h_batch.view.pictures import write_strips

        write_strips(drawings, strips, n=frames, size=size or (480, 400))
        print(strips)
    return 0


def _sees(
    run: Path,
    trial: int,
    rig: str,
    out: Path,
    code: tuple[str, ...],
    *,
    overwrite: bool,
    how: dict[str, Any],
) -> int:
    """`view --sees`; `how`: errors, as `write_sees` takes them."""
    check_output_file(out, overwrite=overwrite, flag="--sees", endings=STRIPS)
    from r2h_batch.runs.store import load_run

    stored = load_run(run)
    planned = stored.header["trials"].get(SPLITS[trial % 2], 0)
    if not 0 <= trial // 2 < planned:
        counts = ", ".join(f"{n} of {s}" for s, n in stored.header["trials"].items())
        raise UsageError(f"--trial is {trial}; {run} has {counts} (ids of S0 are even, of S1 odd)")
    from r2h_batch.observe.rig import load_rig

    cameras = load_rig(rig)
    from r2h_batch.view.sees import write_sees
    from r2h_batch.view.stored import Reader

    reader = Reader(stored, code)
    write_sees(reader, trial, cameras, out, **how)
    print(out)
    return 0
