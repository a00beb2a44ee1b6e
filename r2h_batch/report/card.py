"""Files of a finished sweep for people, beside its rows: the table, the same numbers as JSON, and a
card that makes the run folder a data set of the Hugging Face library."""

import yaml

from r2h_batch.base.io.write import write_text
from r2h_batch.base.table import plain
from r2h_batch.report.table import render, table_of
from r2h_batch.runs.store import Run

TABLE, RESULTS, CARD = "table.md", "results.json", "README.md"

_BODY = """
# {title}

Verdicts on robot-to-human handovers by r2h_batch {r2h_batch}, benchmark {protocol}: {trials}.

{table}

## Files

| | |
|---|---|
| {rows} | a row for each trial: outcome, five criteria with margins (m), reasons, times (s) |
| column `poses` | the scored poses: T_obj_ee and T_world_ee, 4 x 4 row by row, m |
| run.json, methods/ | configuration, digests of code and data, what answered |
| {results}, {table_file} | the table as numbers and as text |

    datasets.load_dataset(FOLDER, METHOD)      # the trials of a method; METHOD is a name under {place}/
    r2h-batch results verify FOLDER            # every file against its checksum
    r2h-batch results reevaluate FOLDER        # rows judged again from their stored poses
"""


def write_summary(run: Run) -> None:
    """Write `table.md`, `results.json` and the card `README.md` of a run.

    Args:
        run: what `load_run` gives; methods that are not complete are left out.
    """
    folder, table = run.folder, table_of(run)
    text = render(table, "md")
    write_text(folder / TABLE, text)
    write_text(folder / RESULTS, render(table, "json"))
    entries = [run.entry(m) for m in run.methods]
    rows = entries[0].data_files.replace(entries[0].slug, "METHOD")
    head = {
        "pretty_name": run.folder.absolute().name,
        "tags": ["robotics", "human-robot-interaction", "handover", "r2h_batch"],
        "configs": [
            {"config_name": e.slug, "data_files": [{"split": "trials", "path": e.data_files}]}
            for e in entries
        ],
    }
    body = _BODY.format(
        **table.origin, title=plain(run.folder.absolute().name), table=text.split("\n\n")[2],
        results=RESULTS, table_file=TABLE, rows=rows, place=rows.partition("/")[0],
    )  # fmt: skip
    front = yaml.safe_dump(head, sort_keys=False, allow_unicode=True)
    write_text(folder / CARD, f"---\n{front}---\n{body}")
