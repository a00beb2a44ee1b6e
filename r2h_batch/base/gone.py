"""Names that r2h_batch 0.3 had and this version has not: commands, flags, options and attributes, each with what to use instead.

Who looks up a name that is unknown asks here too, so that an old command line is told what became of it. Imports nothing.
"""

_NOBODY = "nobody simulates how the object is taken; `results reception RUN` says whether the person can take it"
_SEES = "--sees cell-v1 shows a method what depth cameras see, with their noise"
_IN_RUN = "leave it out: a run folder has its benchmark's files (RUN/benchmark); put there what an older one lacks"
_OPEN_A_RUN = (
    *("report", "why", "view", "export scene", "export release", "export real"),
    *("results reevaluate", "results reception"),
)
_OF_BENCHMARK = (
    *(
        "benchmark",
        "hands",
        "hand-model",
        "objects",
        "object-mesh",
        "grasps",
        "trials-file",
        "robot",
    ),
    *("persons", "people", "receiver", "until", "turn"),
)

GONE = {
    "benchmark hide": 'write a benchmark.yaml with `seed: "32 hexadecimal digits"` and keep it: it has other trials',
    "leaderboard": "`results reevaluate RUN` judges a run again, `compare RUN RUN baselines` compares its methods",
    "submit": "hand over the run folder; `results reevaluate RUN` judges its rows again",
    "figures": "use view RUN --strips FILE with --trial ID, or with --one-of-each",
    "report --perceived": "use study ratings FILE.csv, for ratings of your own",
    "results picked": "sweep with --benchmark r2h-v3, which asks for it, or call r2h_batch.judge.picked (docs/r2h_v3.md)",
    "results viewed": "report has Presented, which says whether the receiver sees the part",
    "study comfort": "use study ratings FILE.csv",
    "study rated": "use study ratings FILE.csv; export trials writes poses, results reception what the person could take",
    "study trials": "use export trials for poses, results reception for what the person could take",
    "sweep --robustness": "sweep once with each --execution-error (docs/results/questions.md#errors-of-execution)",
    "benchmark r2h-v3-draft": "write r2h-v3, which it became",
    "turn": "sweep with --turn into RUN-turned/half and RUN-turned/cycled, then compare RUN (docs/statistics.md#turn-test)",
    "import objects --from hoh": "enter meshes and the receiver's regions as files (docs/your_data.md), or use --from oakink",
    "results held": "--stability physics of a sweep shakes each grasp in physics",
    "import region": "say the receiver's region as parts, a plane or a file of faces: FILE.obj:S1:REGION (docs/your_data.md)",
    "observe export --believed": "a shard's pairs/ holds labelled pairs of the true object",
    "train rank --views": "train on the stream of new instances (leave --views out), and sweep with --sees",
    "sweep --trust-code": "export the network as ONNX (torch.onnx.export) and give --predictor FILE.onnx",
    **{
        f"--method contact,{option}": _SEES
        for option in ("cameras", "depth_noise", "depth_lost", "camera_m", "camera_deg")
    },
    "results transfer": _NOBODY,
    "view --transfer": _NOBODY,
    "view --release": _NOBODY,
    "trials": "write export trials with the same flags",
    "scene": "write export scene RUN with the same flags",
    "export --to": "write export release RUN --out FOLDER",
    "real": "write export real RUN with the same flags",
    "observe": "write export views with the same flags",
    "benchmark": "write ls benchmark FILE to check one, ls benchmark --schema for the schema",
    "benchmark show --builtin": "write ls benchmark --yaml",
    "benchmark show": "write ls benchmark --schema, or ls benchmark --yaml for the default one as a file",
    "benchmark check": "write ls benchmark FILE",
    "Benchmark.evaluator": "write r2h_batch.Evaluator(benchmark, PRESET, device=..., threads=...)",
    "Benchmark.baselines": "write r2h_batch.report.load_baselines(benchmark)",
    "sweep --set": "write each option as its flag: --plan.edge-check moveit, --chunk 64; a file (--config) has the same names",
    **{
        f"sweep --{short}": f"write --{name.replace('_', '-')}, in a file {name}"
        for short, name in {
            "sim": "execute.sim",
            "sim-model": "execute.model",
            "edge-check": "plan.edge_check",
            "plan-hand": "plan.hand",
            "object-collision": "plan.object_collision",
            "ik": "ik.solver",
            "hand-errors": "estimate.errors",
        }.items()
    },
    **{f"{command} --{flag}": _IN_RUN for command in _OPEN_A_RUN for flag in _OF_BENCHMARK},
    "sweep --until taken": f"{_NOBODY}; r2h-v3 ends with --until received",
}
"""A command with the word that went (`COMMAND`, `sweep --FLAG`, `COMMAND SUBCOMMAND`, `COMMAND --FLAG VALUE`,
`--method NAME,OPTION`), or `Class.attribute` -> what to use instead."""


def gone(name: str) -> str:
    """One line about a name that went, as `GONE` spells it; empty where nothing of this name was ever there."""
    how = GONE.get(name)
    return f"{name}: r2h_batch 0.3 had it, this version has not; {how}" if how else ""
