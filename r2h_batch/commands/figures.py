"""The command `figures`: those of the paper. Light until there is work."""

from pathlib import Path

from r2h_batch.base.io.write import check_output_file
from r2h_batch.protocols.choice import DEFAULT, BenchmarkChoice

FIGURES, ENDINGS = ("protocol", "methods", "failures"), ("pdf", "png")
"""Files of `figures`."""


def figures(
    run: Path,
    /,
    *,
    out: Path,
    method: tuple[str, ...] = (),
    trial: int | None = None,
    overwrite: bool = False,
    benchmark: BenchmarkChoice = DEFAULT,
) -> int:
    """Draw the paper's figures of a run folder as PDF and PNG: protocol, methods over time, success
    and failures.

    Args:
        run: a run folder, as `r2h-batch sweep --out` writes it; what it does not store is computed
            again.
        out: folder to write.
        method: only these methods; the first one shows the protocol.
        trial: trial id of the protocol and of the methods over time; the command chooses one by
            default.
        overwrite: replace figures that are there.
        benchmark: where its files are now, if they are not where the sweep found them.
    """
    from r2h_batch.runs.store import load_run
    from r2h_batch.scene.offscreen import ready

    for name in FIGURES:
        for ending in ENDINGS:
            check_output_file(out / f"{name}.{ending}", overwrite=overwrite)
    whole = load_run(run)
    stored = whole.only(method)
    if not stored.methods:
        raise ValueError(f"{run}: no method is complete; run its sweep again to go on")
    if trial is not None:
        stored.holding(trial, stored.methods)  # before torch is imported
    from r2h_batch.report.figures import needs_matplotlib

    needs_matplotlib()
    ready()
    from r2h_batch.view.gallery import pictures
    from r2h_batch.view.stored import Reader

    reader = Reader(whole, benchmark)
    shown = stored.named(method[0]) if method else stored.methods[0]
    drawn = (
        pictures.protocol(stored, reader, shown, trial),
        pictures.methods_over_time(stored, reader, stored.methods, trial),
        pictures.failures(stored, reader, stored.methods),
    )
    for name, (figure, caption) in zip(FIGURES, drawn, strict=True):
        pdf, png = pictures.write(figure, out, name)
        print(f"{pdf}, {png.name}: {caption}")
    return 0
