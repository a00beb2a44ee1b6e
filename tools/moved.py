"""Old addresses of the site lead to where their subject stands now (`hooks` in mkdocs.yml)."""

from typing import Any

from mkdocs.structure.files import File, Files

MOVED = {
    "families": "benchmark.html#objects",
    "people": "benchmark.html#people",
    "receivers": "benchmark.html#people",
    "howto/paper": "your_data.html#the-papers-benchmark",
    "howto/reinforcement_learning": "closed_loop.html",
    "gradients": "training_loop.html#gradients",
    "looking": "howto/report.html#look-at-trials",
    "faults": "sweeps.html#what-can-go-wrong",
    "motion": "choices.html#the-executed-motion",
    "gpu": "results/speed.html#on-a-gpu",
    "pick": "r2h_v3.html",
    "results/families": "results/table1.html",
    "results/table1-v1": "results/table1.html#other-benchmarks-and-presets",
    "results/sensitivity": "results/table1.html#sensitivity",
    "results/findings": "results/table1.html#compare-with-the-paper",
    "results/ranks": "results/questions.html",
    "results/moving": "results/questions.html#hands-that-move",
    "results/robustness": "results/questions.html#errors-of-execution",
    "results/object_errors": "results/questions.html#errors-of-the-objects-pose",
    "results/people": "results/questions.html#people-of-every-size",
    "results/learned": "results/questions.html#a-method-that-learned",
    "results/scans": "results/questions.html#your-own-meshes",
    "results/sees": "results/questions.html#methods-that-see",
    "results/reception": "results/questions.html#can-the-person-take-it",
    "results/robots": "results/questions.html#other-arms",
    "results/observe": "observe.html#errors-of-the-cameras",
    "results/pick": "r2h_v3.html#results",
    "results/whole": "r2h_v3.html#results",
    "results/sources": "results/table1.html",
}
"""Page that went -> page and section that have its subject; both without the folder of the site."""


def on_files(files: Files, config: Any) -> Files:
    """Adds a page at each old address that opens the new one."""
    for old, new in MOVED.items():
        files.append(File.generated(config, f"{old}.html", content=page("../" * old.count("/") + new)))
    return files


def page(target: str) -> str:
    """A page without content that leads to another one."""
    return (
        f'<!doctype html><meta charset="utf-8"><title>Moved</title><meta http-equiv="refresh" content="0; url={target}">'
        f'<link rel="canonical" href="{target}"><p>This page has moved: <a href="{target}">{target}</a></p>\n'
    )
