"""A picture like the paper's Fig. 4: methods x moments for some trials, rendered offscreen.

MUJOCO_GL=osmesa python bench/strips.py docs/baselines_fig4.png --trials 21 5 24
"""

import argparse
import contextlib
import io
import tempfile
from pathlib import Path

METHODS = ("fc", "handover-va", "contact", "intent")
MOMENTS = (0.0, 0.4, 0.7, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("png", type=Path)
    parser.add_argument(
        "--trials", type=int, nargs="+", default=[21, 5, 24], help="trial ids (2 i in S0, 2 i + 1 in S1)"
    )
    parser.add_argument("--noise", default="1", help="--predictor-noise")
    parser.add_argument("--size", type=int, default=300, help="pixels of a frame")
    given = parser.parse_args()

    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from r2h_batch import sweep
    from r2h_batch.export import export_trial, load_trial, render_strip
    from r2h_batch.results import load_run

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "run"
        line = ["--method", *METHODS, "--trials", str(max(given.trials) // 2 + 1), "--predictor-noise", given.noise]
        with contextlib.redirect_stdout(io.StringIO()):
            if code := sweep.main([*line, "--save-paths", "--out", str(folder)]):
                raise SystemExit(code)
        names = load_run(folder).methods
        figure, axes = plt.subplots(
            len(names), len(given.trials), squeeze=False, layout="constrained",
            figsize=(len(MOMENTS) * len(given.trials) * 1.35, 1.75 * len(names)),
        )  # fmt: skip
        for j, trial in enumerate(given.trials):
            for i, name in enumerate(names):
                stored = load_trial(folder, trial, method=name)
                scene = export_trial(stored, Path(temporary) / f"{trial}-{i}")
                png = Path(temporary) / f"{trial}-{i}.png"
                render_strip(scene, png, moments=MOMENTS, width=given.size, height=given.size)
                verdict = stored.row["outcome"] + (
                    f" ({stored.row['plan_reason']})" if stored.row["outcome"] == "plan" else ""
                )
                axes[i, j].imshow(plt.imread(png))
                axes[i, j].set_axis_off()
                side = (
                    f"trial {trial}, {stored.row['object'].replace('_', ' ')}, {stored.row['side']} hand\n"
                    if i == 0
                    else ""
                )
                axes[i, j].set_title(f"{side}{name}: {verdict}", fontsize=7)
        given.png.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(given.png, dpi=140)
    print(given.png)


if __name__ == "__main__":
    main()
